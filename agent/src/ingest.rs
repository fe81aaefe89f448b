//! From a folder of photographs to a dataset that can be trained on, in its place on the earth.
//!
//! COLMAP finds where the photographs were taken ([`stages`]), in a frame and a scale of its own. GPS and control points
//! tell where that frame lies ([`placing`]); then the dataset is written in ENU of the site ([`publishing`]).
//!
//! The folder `.ingest` of the dataset keeps COLMAP's work, so that a run that was stopped goes on where it was.
//!
//! What it knows nothing about: splats and training. Where to start reading: [`ingest`].

mod colmap;
mod control;
mod error;
mod pairs;
mod photographs;
mod placing;
mod publishing;
mod recipe;
mod reconstruction;
mod stages;

use std::fs;
use std::path::{Path, PathBuf};

use cosurf_contract::{AgentEvent, IngestReport, IngestStage};
use cosurf_geo::{GeoError, Geodetic, Georeference, Up};
use cosurf_scene::{Dataset, FolderLock, SceneError};
use glam::DVec3;

use colmap::Colmap;
pub use error::IngestError;
use photographs::Photographs;
use placing::{Placed, Places, up_of, upright};
use recipe::Recipe;
use reconstruction::Reconstruction;
use stages::Stages;

/// Folder of COLMAP's work in that of the dataset.
const WORK: &str = ".ingest";
/// Fewest photographs with a pose.
const POSED_MIN: usize = 3;

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

/// Makes a dataset. `tell` gets progress, and what is left out.
pub fn ingest(plan: &IngestPlan, tell: &mut dyn FnMut(AgentEvent)) -> Result<Ingested, IngestError> {
    let work = plan.out.join(WORK);
    refuse_occupied(&plan.out, &work)?;
    let _lock = FolderLock::take(&work, "cosurf-agent ingest")?;
    let colmap = Colmap::find(&plan.colmap)?;
    let photographs = Photographs::read(&plan.photographs)?;
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
    let places = Places::of(&photographs, plan.origin)?;

    let recipe = Recipe::new(&colmap, &photographs, &work, plan.max_size_px)?;
    let mut stages = Stages::new(&colmap, &work, recipe.key(), tell);
    stages.run(&recipe.features()?)?;
    stages.run(&recipe.matches()?)?;
    stages.run(&recipe.poses()?)?;
    let log = stages.log(IngestStage::Poses);
    let found = recipe.reconstructions(&log)?;
    let (chosen, its) = choose(&found, places.as_ref());
    if its.posed.len() < POSED_MIN {
        return Err(IngestError::NoPoses { posed: its.posed.len(), photographs: count, log });
    }
    stages.run(&recipe.undistorting(chosen, its.posed.len())?)?;

    let (dataset, _) = Dataset::open_within(&recipe.undistorted(), usize::MAX)?;
    let points: Vec<DVec3> = dataset.points.iter().map(|point| point.position).collect();
    let poses = dataset.views.iter().map(|view| &view.camera.cam_from_world);
    let up = up_of(poses, &points).ok_or(IngestError::NoPoses { posed: 0, photographs: count, log })?;
    let placed = place(places.as_ref(), its, &up)?;
    tell_left_out(tell, &unposed(&photographs, its, &found));
    tell_left_out(tell, &placed.left_out);
    let Placed { similarity, georeference, .. } = placed;
    let (posed, points) = (dataset.views.len(), dataset.points.len());
    publishing::publish(&plan.out, &work, dataset, &similarity, georeference.as_ref())?;
    let report = IngestReport { photographs: all, posed, points, georeferenced: georeference.is_some() };
    tell(AgentEvent::Ingested { report: report.clone() });
    Ok(Ingested { report, georeference })
}

/// Places a reconstruction; only upright if nothing tells where it lies.
fn place(places: Option<&Places>, its: &Reconstruction, up: &Up) -> Result<Placed, IngestError> {
    match places.map(|places| places.place(its, up)) {
        Some(Err(GeoError::NoFit(reason))) => {
            let left_out = vec![("the place on the earth".to_owned(), reason.to_owned())];
            Ok(Placed { left_out, ..upright(up) })
        }
        Some(placed) => Ok(placed?),
        None => Ok(upright(up)),
    }
}

/// An existing dataset of somebody else must not be replaced, nor the photographs by their undistorted pictures.
fn refuse_occupied(out: &Path, work: &Path) -> Result<(), IngestError> {
    let is_ours = work.is_dir();
    let is_empty = match fs::read_dir(out) {
        Ok(mut entries) => entries.next().is_none(),
        Err(cause) if cause.kind() == std::io::ErrorKind::NotFound => true,
        Err(cause) => return Err(SceneError::io(out, cause).into()),
    };
    if is_ours || is_empty { Ok(()) } else { Err(IngestError::Occupied { folder: out.to_owned() }) }
}

/// The reconstruction that most GPS agrees with, or else with most photographs. Returns its folder, too.
fn choose<'a>(
    found: &'a [(PathBuf, Reconstruction)],
    places: Option<&Places>,
) -> (&'a Path, &'a Reconstruction) {
    let worth = |its: &Reconstruction| {
        let up = up_of(its.posed.iter().map(|posed| &posed.cam_from_world), &[]);
        let placed = places.zip(up).and_then(|(places, up)| places.place(its, &up).ok());
        (placed.map_or(0, |placed| placed.agreeing), its.posed.len())
    };
    let best =
        found.iter().max_by_key(|(_, its)| worth(its)).expect("`reconstructions` fails if there are none");
    (&best.0, &best.1)
}

/// Names and reasons of photographs without a pose in the chosen reconstruction.
fn unposed(
    photographs: &Photographs,
    its: &Reconstruction,
    found: &[(PathBuf, Reconstruction)],
) -> Vec<(String, String)> {
    let has = |its: &Reconstruction, name: &str| {
        its.posed.binary_search_by(|posed| posed.name.as_str().cmp(name)).is_ok()
    };
    let missing = photographs.usable.iter().filter(|photograph| !has(its, &photograph.name));
    let reason = |name: &str| match found.iter().find(|(_, other)| has(other, name)) {
        Some((_, other)) => format!(
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
