//! Loads equal models into both backends, and compares their numbers.

use cosurf_scene::Splats;

use crate::backend::{Backend, Channels};
use crate::budget::Capacity;
use crate::cpu::CpuBackend;
use crate::gpu::backend::GpuBackend;
use crate::gpu::context::Gpu;

/// Largest allowed error of a number, relative to the larger of its magnitude and a hundredth of its group's root mean
/// square.
const TOLERANCE: f32 = 1e-3;
/// Share of the numbers that may differ by more than [`TOLERANCE`], because rounding may decide whether a
/// splat reaches a threshold.
pub(super) const TIES_MAX: f64 = 5e-3;

/// Capacity for somewhat more splats than `splats` has.
pub(super) fn capacity(splats: &Splats, size_px: [u32; 2]) -> Capacity {
    Capacity {
        splats: splats.len() + 100,
        pairs: 60_000,
        size_px,
        sh_degree: splats.sh_degree,
        channels: Channels::Geometry,
        training: true,
    }
}

pub(super) fn on_gpu(gpu: &Gpu, splats: &Splats, size_px: [u32; 2]) -> GpuBackend {
    let mut backend = GpuBackend::new(gpu, capacity(splats, size_px)).expect("room");
    backend.load(splats);
    backend
}

pub(super) fn on_cpu(splats: &Splats, size_px: [u32; 2]) -> CpuBackend {
    let mut backend = CpuBackend::new(capacity(splats, size_px), 2);
    backend.load(splats);
    backend
}

/// The numbers of all splats in groups: means, quaternions, log scales, opacity logits, SH coefficients.
fn groups(splats: &Splats) -> [Vec<f32>; 5] {
    [
        splats.means.concat(),
        splats.quats.concat(),
        splats.log_scales.concat(),
        splats.opacity_logits.clone(),
        splats.sh.clone(),
    ]
}

/// Number of values of a group that differ from the expected ones by more than the tolerance.
pub(super) fn off_of(got: &[f32], expected: &[f32]) -> usize {
    let squares: f64 = expected.iter().map(|v| f64::from(*v).powi(2)).sum();
    let floor = 0.01 * (squares / expected.len().max(1) as f64).sqrt() as f32 + 1e-20;
    let within =
        |(got, expected): (&f32, &f32)| (got - expected).abs() <= TOLERANCE * expected.abs().max(floor);
    got.iter().zip(expected).filter(|pair| !within(*pair)).count()
}

/// Compares all numbers of two models: how many there are, and how many differ by more than the tolerance.
pub(super) fn compare(got: &Splats, expected: &Splats) -> (usize, usize) {
    let groups = || groups(got).into_iter().zip(groups(expected));
    (
        groups().map(|(_, expected)| expected.len()).sum(),
        groups().map(|(got, expected)| off_of(&got, &expected)).sum(),
    )
}
