//! Divides the memory limit of a merge between the student (the model that is trained) and its teachers.

use cosurf_engine::backend::Channels;
use cosurf_engine::budget::{Costs, DRIVER_BYTES, PAIRS_PER_SEEN_SPLAT, PAIRS_PER_SPLAT};
use cosurf_engine::{Capacity, Device};
use cosurf_scene::{Camera, Splats};

use super::settings::MergeSettings;

/// Share of the memory for the student; the teachers get the rest.
const STUDENT_SHARE: f64 = 0.6;

/// Bytes of the memory limit that are left beside the driver of a graphics card.
fn bytes_beside_driver(device: &Device, settings: &MergeSettings) -> f64 {
    let driver = if device.is_gpu() { DRIVER_BYTES } else { 0 };
    settings.memory_bytes.saturating_sub(driver) as f64
}

/// Largest number of splats that can be trained at once. All their buffers must fit into the student's share of the
/// memory, and each buffer into one binding of a graphics card.
pub(super) fn student_room(
    device: &Device,
    settings: &MergeSettings,
    sh_degree: u32,
    cameras: &[Vec<Camera>],
) -> usize {
    let all: Vec<Camera> = cameras.iter().flatten().copied().collect();
    let shape = Capacity::to_train(&Splats::with_capacity(0, sh_degree), &all, Channels::Geometry);
    let costs = Costs::of(&shape, device.binding_bytes_max());
    let each = costs.splat + PAIRS_PER_SEEN_SPLAT * costs.pair;
    let bytes = STUDENT_SHARE * bytes_beside_driver(device, settings) - costs.pictures as f64;
    ((bytes.max(0.0) / each as f64) as usize).min(costs.splats_max(PAIRS_PER_SEEN_SPLAT))
}

/// Limit on the bytes of all teachers and their cached renderings together.
pub(super) fn teachers_bytes(device: &Device, settings: &MergeSettings) -> u64 {
    ((1.0 - STUDENT_SHARE) * bytes_beside_driver(device, settings)) as u64
}

/// Bytes that a teacher with `splats` splats takes, with the buffers for the largest picture of all `cameras`.
pub(super) fn renderer_bytes(device: &Device, splats: usize, sh_degree: u32, cameras: &[Vec<Camera>]) -> u64 {
    let pixels = cameras.iter().flatten().map(|c| c.size_px[0] as usize * c.size_px[1] as usize).max();
    let costs = Costs::of(&Capacity::to_render(sh_degree), device.binding_bytes_max());
    (splats * (costs.splat + PAIRS_PER_SPLAT * costs.pair) + 64 * pixels.unwrap_or(0)) as u64
}
