//! The F-score of a model's surface.

use std::ops::ControlFlow;
use std::thread::available_parallelism;

use anyhow::Result;
use cosurf_aggregator::evaluate::accuracy;
use cosurf_aggregator::mesh::{FuseSettings, MeshSource, mesh_file};
use cosurf_scene::{Camera, LocalFrame, Mesh, Splats, ply};

/// Memory limit of the mesh, bytes.
const MESH_BYTES: u64 = 4 << 30;

/// F-score, 0..=1, of the mesh that is fused from the depth rendered at the cameras. Distances from the true surface of
/// at most `threshold_m` are correct.
pub(crate) fn f_score(splats: Splats, cameras: &[Camera], truth: &Mesh, threshold_m: f64) -> Result<f64> {
    let settings = FuseSettings { voxel_m: None, memory_bytes: MESH_BYTES };
    let threads = available_parallelism().map_or(1, usize::from);
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("model.ply");
    ply::write(&path, &splats, &LocalFrame::WORLD)?;
    drop(splats);
    let go = |_| ControlFlow::Continue(());
    let source = MeshSource { model: path, frame: &LocalFrame::WORLD, cameras, max_size_px: None };
    let fused = mesh_file(&source, &settings, threads, go)?;
    let (accuracy, _) = accuracy::judge(&fused.mesh, truth, threshold_m, 0)?;
    Ok(accuracy.samples.f_score)
}
