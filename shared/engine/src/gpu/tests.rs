//! Compares the GPU backend with the CPU backend, on any adapter, including software drivers.
//!
//! Without an adapter, the tests print a line and are skipped. If the environment variable `REQUIRE_GPU` is set, they
//! fail instead.

mod adapter;
mod compare;
mod constants;
mod forward;
mod gradients;
mod limits;
mod scores;
mod shaders;
mod sort;
mod state;
mod surface;
mod train;

use cosurf_scene::{Camera, Splats};

use crate::backend::Backend;
use crate::{AnyBackend, Capacity, Device, DeviceError, PruneScore, prune};

/// Importance of each splat to the pictures of `cameras`, computed by `device`.
fn importance(
    splats: &Splats,
    cameras: &[Camera],
    capacity: Capacity,
    device: &Device,
) -> Result<Vec<f32>, DeviceError> {
    let mut backend = AnyBackend::new(device, capacity, 2)?;
    backend.load(splats);
    let scores = prune::survey(&mut backend, cameras);
    let shapes = backend.take_shapes();
    device.check()?;
    Ok(prune::importance_by(&shapes, &scores, PruneScore::Corrected))
}
