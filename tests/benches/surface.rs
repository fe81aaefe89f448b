//! The F-score of a model's surface.

use std::ops::ControlFlow;
use std::thread::available_parallelism;

use anyhow::Result;
use cosurf_aggregator::evaluate::accuracy;
use cosurf_aggregator::mesh::{FuseSettings, mesh_model};
use cosurf_scene::{Camera, Mesh, Splats};

/// Memory limit of the mesh, bytes.
const MESH_BYTES: u64 = 4 << 30;

/// F-score, 0..=1, of the mesh that is fused from the depth rendered at the cameras. Distances from the true surface of
/// at most `threshold_m` are correct.
pub(crate) fn f_score(splats: Splats, cameras: &[Camera], truth: &Mesh, threshold_m: f64) -> Result<f64> {
    let settings = FuseSettings { voxel_m: None, memory_bytes: MESH_BYTES };
    let threads = available_parallelism().map_or(1, usize::from);
    let fused = mesh_model(splats, cameras, None, &settings, threads, |_| ControlFlow::Continue(()))?;
    let (accuracy, _) = accuracy::judge(&fused.mesh, truth, threshold_m, 0)?;
    Ok(accuracy.samples.f_score)
}
