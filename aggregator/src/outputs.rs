//! What is made of a global model for people: `mesh.ply`, a report with pictures that needs no photographs, and a survey
//! with its progress.
//!
//! What it knows nothing about: how the model was merged, beyond the record of the merge, and when a report is due, which
//! the service decides.
//!
//! Where to start reading: [`report`].

mod client;
mod deliver;
mod relief;

use std::ops::ControlFlow;

use cosurf_engine::ViewError;
use cosurf_scene::{Camera, Caster, Dataset, LocalFrame, atomic, evenly_spaced, files};

use crate::mesh::MeshError;
use crate::report::{MeshSummary, SitePicture, SiteReport, site_page};
use crate::service::{Merging, ReportError, ReportTask, Reported, file_hash, global_ply, remove};
use crate::views::open_within;
pub(crate) use client::{Truth, client};
pub use deliver::deliver;
pub(crate) use relief::{Relief, relief};

/// Number of cameras whose views the report shows.
const VIEWS: usize = 4;
/// Long side of the pictures in the report, px.
const PICTURE_PX: u32 = 640;

/// Makes `mesh.ply`, `report.json` and `report.html` of the newest global model in a service's folder, unless they are
/// those of this model already. It is no error if no mesh can be made: the report says so.
pub fn report(task: &ReportTask) -> Result<Reported, ReportError> {
    let merging = Merging::read(&task.folder).ok_or(ReportError::Stopped)?;
    if let Some(known) = known(task, &merging) {
        return Ok(reported(&known, false));
    }
    let mut cameras = Dataset::cameras(&task.folder)?;
    let frame = LocalFrame::of(cameras.iter());
    cameras.iter_mut().for_each(|camera| *camera = frame.local_camera(camera));
    let mesh = make_mesh(task, &cameras, &frame)?;
    let (summary, mesh_blake3, mesh_failure, caster) = match mesh {
        Mesh::Made { summary, blake3, caster } => (Some(summary), Some(blake3), None, Some(caster)),
        Mesh::Missing(reason) => (None, None, Some(reason), None),
    };
    let (pictures, pictures_failure) = match pictures(task, &evenly_spaced(&cameras, VIEWS), &frame, caster)?
    {
        Ok(pictures) => (pictures, None),
        Err(reason) => (Vec::new(), Some(reason)),
    };
    let (site, cameras) = (task.site.to_string(), cameras.len());
    let report =
        SiteReport { site, cameras, mesh: summary, mesh_blake3, mesh_failure, pictures_failure, merging };
    let at = |name| task.folder.join(name);
    let client = client(&task.folder, task.memory_bytes, task.threads, None);
    atomic::write_bytes(&at("report.html"), site_page(&report, &pictures, &client).as_bytes())?;
    atomic::write_bytes(&at("report.json"), &serde_json::to_vec_pretty(&report)?)?;
    Ok(reported(&report, true))
}

fn reported(report: &SiteReport, is_new: bool) -> Reported {
    let triangles = report.mesh.map(|mesh| mesh.triangles);
    let mesh_failure = report.mesh_failure.clone();
    Reported { revision: report.merging.revision, triangles, mesh_failure, is_new }
}

/// The report in the folder, if it is that of this merge and its files are whole.
fn known(task: &ReportTask, merging: &Merging) -> Option<SiteReport> {
    let at = |name| task.folder.join(name);
    let report: SiteReport = serde_json::from_slice(&files::read(&at("report.json")).ok()?).ok()?;
    let is_it = |blake3: &String| file_hash(&at("mesh.ply")).is_ok_and(|hash| hash == *blake3);
    let is_whole = report.mesh.is_none() || report.mesh_blake3.as_ref().is_some_and(is_it);
    (report.merging == *merging && is_whole && at("report.html").is_file()).then_some(report)
}

enum Mesh {
    /// `blake3` is the hash of its file.
    Made { summary: MeshSummary, blake3: String, caster: Caster },
    /// With the reason.
    Missing(String),
}

fn make_mesh(task: &ReportTask, cameras: &[Camera], frame: &LocalFrame) -> Result<Mesh, ReportError> {
    let (model, file) = (global_ply(&task.folder), task.folder.join("mesh.ply"));
    let goes_on = |_| if task.is_stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    match relief(&model, cameras, frame, task.memory_bytes, task.threads, &file, goes_on)? {
        Relief::Made { summary, caster } => Ok(Mesh::Made { summary, blake3: file_hash(&file)?, caster }),
        Relief::Missing(MeshError::Stopped) => Err(ReportError::Stopped),
        Relief::Missing(error) => {
            remove(&file)?; // that of an earlier revision
            Ok(Mesh::Missing(error.to_string()))
        }
    }
}

/// What the model, and its mesh if there is one, show from some cameras; the reason if that takes too much memory.
fn pictures(
    task: &ReportTask,
    cameras: &[Camera],
    frame: &LocalFrame,
    mesh: Option<Caster>,
) -> Result<Result<Vec<SitePicture>, String>, ReportError> {
    let cameras: Vec<Camera> = cameras.iter().map(|camera| camera.fitted(PICTURE_PX)).collect();
    // First all of the mesh, so that mesh and splats are not in memory at once.
    let casts: Vec<_> = cameras.iter().map(|camera| Some(mesh.as_ref()?.cast(camera))).collect();
    drop(mesh);
    let mut views = open_within(global_ply(&task.folder), frame, task.memory_bytes, task.threads)?;
    views.expect(cameras.clone());
    let mut pictures = Vec::new();
    for (camera, mesh) in cameras.iter().zip(casts) {
        if task.is_stopped() {
            return Err(ReportError::Stopped);
        }
        match views.render(camera) {
            Ok(rendering) => pictures.push(SitePicture::of(&rendering, mesh, frame.unit())?),
            Err(ViewError::Scene(error)) => return Err(error.into()),
            Err(error) => return Ok(Err(error.to_string())),
        }
    }
    Ok(Ok(pictures))
}
