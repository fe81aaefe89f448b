//! Structures that Rust and the shaders share. A test compares their layouts with `types.wgsl`, which documents their
//! fields.

use bytemuck::{Pod, Zeroable};

use crate::backend::AdamRates;
use crate::layout::view::{RelativePose, ViewParams};

/// Mirrors `View` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct View {
    pub(super) cam_from_world: [[f32; 4]; 3],
    pub(super) eye: [f32; 3],
    pub(super) sh_degree: u32,
    pub(super) focal_px: [f32; 2],
    pub(super) center_px: [f32; 2],
    pub(super) slope_min: [f32; 2],
    pub(super) slope_max: [f32; 2],
    pub(super) size_px: [u32; 2],
    pub(super) tiles: [u32; 2],
    pub(super) splats: u32,
    pub(super) splat_stride: u32,
    pub(super) pair_capacity: u32,
    pub(super) planes: u32,
    pub(super) far: f32,
    pub(super) unused_1: u32,
    pub(super) unused_2: u32,
    pub(super) unused_3: u32,
}

impl View {
    pub(super) fn new(params: &ViewParams, splats: usize, splat_stride: usize, pair_capacity: usize) -> Self {
        let row = |r: usize| {
            let [x, y, z] = params.rotation[r];
            [x, y, z, params.translation[r]]
        };
        Self {
            cam_from_world: [0, 1, 2].map(row),
            eye: params.eye,
            sh_degree: params.sh_degree,
            focal_px: params.focal_px,
            center_px: params.center_px,
            slope_min: params.slope_min,
            slope_max: params.slope_max,
            size_px: params.size_px,
            tiles: params.tiles().map(|tiles| tiles as u32),
            splats: splats as u32,
            splat_stride: splat_stride as u32,
            pair_capacity: pair_capacity as u32,
            planes: 0,
            far: params.far,
            unused_1: 0,
            unused_2: 0,
            unused_3: 0,
        }
    }
}

/// Mirrors `Projected` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Projected {
    pub(super) mean_px: [f32; 2],
    pub(super) extent_px: [f32; 2],
    pub(super) falloff: [f32; 3],
    pub(super) log2_opacity: f32,
    pub(super) rgb: [f32; 3],
    pub(super) falloff_max: f32,
    pub(super) normal: [f32; 3],
    pub(super) plane_distance: f32,
}

/// Mirrors `SortStep` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SortStep {
    pub(super) counter: u32,
    pub(super) shift: u32,
}

/// Mirrors `ScanStep` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct ScanStep {
    pub(super) counter: u32,
    pub(super) digits: u32,
    pub(super) total: u32,
    pub(super) unused: u32,
}

/// Mirrors `LossSettings` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct LossSettings {
    pub(super) gain: f32,
    pub(super) offset: f32,
    pub(super) l1_weight: f32,
    pub(super) ssim_weight: f32,
    pub(super) is_floats: u32,
    pub(super) unused_1: u32,
    pub(super) unused_2: u32,
    pub(super) unused_3: u32,
}

/// Mirrors `BackwardWeights` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct BackwardWeights {
    pub(super) scale: f32,
}

/// Mirrors `Rates` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Rates {
    pub(super) mean: f32,
    pub(super) quat: f32,
    pub(super) log_scale: f32,
    pub(super) opacity: f32,
    pub(super) sh_dc: f32,
    pub(super) sh_rest: f32,
    pub(super) first_correction: f32,
    pub(super) second_correction: f32,
}

impl From<&AdamRates> for Rates {
    fn from(rates: &AdamRates) -> Self {
        let AdamRates { mean, quat, log_scale, opacity, sh_dc, sh_rest, first_correction, second_correction } =
            *rates;
        Self { mean, quat, log_scale, opacity, sh_dc, sh_rest, first_correction, second_correction }
    }
}

/// Mirrors `SurfaceWeights` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SurfaceWeights {
    pub(super) normal: f32,
    pub(super) reprojection: f32,
    pub(super) ncc: f32,
    pub(super) teacher_depth: f32,
    pub(super) teacher_normal: f32,
    pub(super) samples: u32,
    pub(super) sums_first: u32,
    pub(super) cell_px: u32,
    pub(super) draw: [u32; 2],
}

/// Mirrors `EditStep` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct EditStep {
    pub(super) first_row: u32,
    pub(super) rows: u32,
    pub(super) splat_stride: u32,
    pub(super) moves: u32,
    pub(super) copied: u32,
}

/// Mirrors `Pair` in `types.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Pair {
    pub(super) there_from_here: [[f32; 4]; 3],
    pub(super) focal_px: [f32; 2],
    pub(super) center_px: [f32; 2],
    pub(super) size_px: [u32; 2],
    pub(super) unused_1: u32,
    pub(super) unused_2: u32,
}

impl Pair {
    pub(super) fn new(there_from_here: &RelativePose, there: &ViewParams) -> Self {
        let row = |r: usize| {
            let [x, y, z] = there_from_here.rotation[r];
            [x, y, z, there_from_here.translation[r]]
        };
        Self {
            there_from_here: [0, 1, 2].map(row),
            focal_px: there.focal_px,
            center_px: there.center_px,
            size_px: there.size_px,
            unused_1: 0,
            unused_2: 0,
        }
    }
}

/// Indices in the buffer of counters, as in `types.wgsl`.
pub(super) const SPLATS: usize = 0;
pub(super) const VISIBLE: usize = 1;
pub(super) const PAIRS_WANTED: usize = 2;
pub(super) const PAIRS: usize = 3;
/// Index of a counter for totals that nothing reads.
pub(super) const UNUSED: usize = 4;
/// Length of the buffer of counters.
pub(super) const COUNTERS: usize = 8;
