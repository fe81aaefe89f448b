//! From a folder of photographs to a dataset that can be trained on, in its place on the earth.
//!
//! COLMAP finds where the photographs were taken ([`finding`]), in a frame and a scale of its own. GPS and control points
//! tell where that frame lies ([`placing`]), and straighten it ([`adjustment`]); then the dataset is written in ENU of the
//! site ([`publishing`]). Photographs whose poses another tool has found are only undistorted ([`given`]).
//!
//! The folder `.ingest` of the dataset keeps COLMAP's work, so that a run that was stopped goes on where it was. A finished
//! dataset has `ingest.json`, too: by it, the folder is ours even without `.ingest`.
//!
//! What it knows nothing about: splats and training. Where to start reading: [`ingest`].

mod adjustment;
mod colmap;
mod control;
mod error;
mod finding;
mod given;
mod gps;
mod lens;
mod masks;
mod names;
mod pairs;
mod photographs;
mod placing;
mod plausible;
mod publishing;
mod recipe;
mod reconstruction;
mod settling;
mod stages;
mod straight;
mod vertical;

use std::fs;
use std::path::{Path, PathBuf};

use cosurf_contract::{AgentEvent, IngestReport, IngestStage};
use cosurf_geo::{Geodetic, Georeference};
use cosurf_scene::{Dataset, FolderLock, SceneError, files};

use colmap::Colmap;
pub use error::IngestError;
use finding::{Found, find};
use given::Given;
use photographs::Photographs;
use placing::Places;
use plausible::missing_photographs;
use publishing::Poses;
use recipe::Recipe;
use reconstruction::Reconstruction;
use stages::Stages;

/// Folder of COLMAP's work in that of the dataset.
const WORK: &str = ".ingest";

/// What to make of which photographs.
#[derive(Clone, Debug)]
pub struct IngestPlan {
    /// The folder of the photographs.
    pub photographs: PathBuf,
    /// The folder of the dataset.
    pub out: PathBuf,
    /// COLMAP's program.
    pub colmap: PathBuf,
    /// Origin of the site; `None` takes the middle of the photographs.
    pub origin: Option<Geodetic>,
    /// Grid of the geoid that heights of `gcp_list.txt` and `geo.txt` are above; `None` if they are above the ellipsoid.
    pub geoid: Option<PathBuf>,
    /// Largest side of the dataset's pictures, pixels.
    pub max_size_px: u32,
}

/// What was made.
#[derive(Clone, Debug)]
pub struct Ingested {
    /// The figures.
    pub report: IngestReport,
    /// The place; `None` if nothing tells it.
    pub georeference: Option<Georeference>,
}

/// Whether a dataset, given by its folder or file, was made of photographs of which nothing tells where on the earth they
/// were taken. Its frame is then one of its own. Of other datasets, the user knows the frame.
pub fn is_without_place(data: &Path) -> bool {
    let folder = files::folder_of(data);
    publishing::is_finished(folder, Poses::Found) && !folder.join(Georeference::FILE).is_file()
}

/// Makes a dataset. If the folder has poses, they are taken, and only the pictures are undistorted. `tell` gets progress, and
/// what is left out.
pub fn ingest(plan: &IngestPlan, tell: &mut dyn FnMut(AgentEvent)) -> Result<Ingested, IngestError> {
    let work = plan.out.join(WORK);
    refuse_occupied(&plan.out, &work)?;
    refuse_own_pictures(plan)?;
    let _lock = FolderLock::take(&work, "cosurf-agent ingest")?;
    let colmap = Colmap::find(&plan.colmap)?;
    if Dataset::has_poses(&plan.photographs) {
        return ingest_given(plan, &colmap, &work, tell);
    }
    let mut photographs = Photographs::read(&plan.photographs)?;
    if let Some(grid) = &plan.geoid {
        vertical::raise(&mut photographs, grid)?;
    }
    let photographs = masks::prepare(photographs, &work)?;
    let count = photographs.usable.len();
    let all = count + photographs.left_out.len();
    tell(AgentEvent::Ingesting {
        stage: IngestStage::Reading,
        done: count,
        of: all,
        seconds_left: None,
        resumed: false,
    });
    tell_left_out(tell, &photographs.left_out);
    tell_left_out(tell, &photographs.notes);
    tell_left_out(tell, missing_photographs(&photographs.usable, &photographs.control).as_slice());
    let places = Places::of(&photographs, plan.origin)?;

    let recipe = Recipe::new(&colmap, &photographs, &work, plan.max_size_px)?;
    let mut stages = Stages::new(&colmap, &work, recipe.key(), tell);
    stages.run(&recipe.features()?)?;
    stages.run(&recipe.matches()?)?;
    let Found { its, placed, others, .. } = find(&recipe, &mut stages, places.as_ref(), count)?;
    stages.run(&recipe.undistorting(&its)?)?;

    masks::join(&work, &recipe.undistorted())?;
    let dataset = Dataset::open(&recipe.undistorted())?;
    tell_left_out(tell, &unposed(&photographs, &its, &others));
    tell_left_out(tell, &placed.left_out);
    let georeference = placed.georeference;
    publishing::publish(&plan.out, &work, &dataset, georeference.as_ref())?;
    let (posed, points) = (dataset.views.len(), dataset.points.len());
    let report = IngestReport { photographs: all, posed, points, georeferenced: georeference.is_some() };
    publishing::finish(&plan.out, &photographs.folder, &report, Poses::Found)?;
    tell(AgentEvent::Ingested { report: report.clone() });
    Ok(Ingested { report, georeference })
}

/// Makes a dataset of photographs whose poses another tool has found.
fn ingest_given(
    plan: &IngestPlan,
    colmap: &Colmap,
    work: &Path,
    tell: &mut dyn FnMut(AgentEvent),
) -> Result<Ingested, IngestError> {
    let given = Given::read(&plan.photographs, work, plan.origin)?;
    let dataset = given.undistort(colmap, work, plan.max_size_px, tell)?;
    let (dataset, damaged) = given.without_damaged(dataset);
    tell_left_out(tell, &damaged);
    tell_left_out(tell, given.left_out.as_slice());
    for masks in ["masks", "masks_inverted"].map(|name| plan.photographs.join(name)) {
        if masks.is_dir() {
            let reason =
                "masks of pictures with given poses are not undistorted; undistort them yourself".into();
            tell(AgentEvent::LeftOut { name: masks.display().to_string(), reason });
        }
    }
    publishing::publish(&plan.out, work, &dataset, given.georeference.as_ref())?;
    let report = given.report(&dataset);
    publishing::finish(&plan.out, &plan.photographs, &report, Poses::Given)?;
    tell(AgentEvent::Ingested { report: report.clone() });
    Ok(Ingested { report, georeference: given.georeference })
}

/// An existing dataset of somebody else must not be replaced, nor the photographs by their undistorted pictures.
fn refuse_occupied(out: &Path, work: &Path) -> Result<(), IngestError> {
    let is_ours = work.is_dir()
        || [Poses::Found, Poses::Given].iter().any(|poses| publishing::is_finished(out, *poses));
    let is_empty = match fs::read_dir(out) {
        Ok(mut entries) => entries.next().is_none(),
        Err(cause) if cause.kind() == std::io::ErrorKind::NotFound => true,
        Err(cause) => return Err(SceneError::io(out, cause).into()),
    };
    if is_ours || is_empty { Ok(()) } else { Err(IngestError::Occupied { folder: out.to_owned() }) }
}

/// The pictures of a dataset must not be taken for photographs: they would be undistorted twice, and replaced.
fn refuse_own_pictures(plan: &IngestPlan) -> Result<(), IngestError> {
    let [photographs, own] = [&plan.photographs, &plan.out.join("images")].map(fs::canonicalize);
    match (photographs, own) {
        (Ok(photographs), Ok(own)) if photographs.starts_with(&own) => {
            Err(IngestError::OwnPictures { photographs: plan.photographs.clone(), out: plan.out.clone() })
        }
        _ => Ok(()),
    }
}

/// Names and reasons of photographs without a pose in the chosen reconstruction.
fn unposed(
    photographs: &Photographs,
    its: &Reconstruction,
    others: &[Reconstruction],
) -> Vec<(String, String)> {
    let has = |its: &Reconstruction, name: &str| {
        its.posed.binary_search_by(|posed| posed.name.as_str().cmp(name)).is_ok()
    };
    let missing = photographs.usable.iter().filter(|photograph| !has(its, &photograph.name));
    let reason = |name: &str| match others.iter().find(|other| has(other, name)) {
        Some(other) => format!(
            "belongs to another part of {} photographs that shares too little ground with the chosen part; ingest it alone",
            other.posed.len()
        ),
        None => "shares too little ground with the others, or is blurred".to_owned(),
    };
    missing.map(|photograph| (photograph.name.clone(), reason(&photograph.name))).collect()
}

fn tell_left_out(tell: &mut dyn FnMut(AgentEvent), left_out: &[(String, String)]) {
    for (name, reason) in left_out {
        tell(AgentEvent::LeftOut { name: name.clone(), reason: reason.clone() });
    }
}

#[cfg(all(test, unix))]
mod tests;
