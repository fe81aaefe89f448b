//! The projection pass: computes the 2D Gaussian, the colour and the plane of each splat for one camera.

use std::f32::consts::LOG2_E;

use rayon::prelude::*;

use super::blocks::Blocks;
use super::geometry::{geometry, plane};
use crate::layout::constants::{ALPHA_MIN, NEAR};
use crate::layout::harmonics::{self, view_direction};
use crate::layout::rows::{LOG_SCALE, MEAN, OPACITY, QUAT, SH};
use crate::layout::view::ViewParams;
use crate::simd::{GROUP, Isa, Kernel, Lanes, Row, each};

/// A projected splat as the rasteriser reads it, in one cache line.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(crate) struct Projected {
    pub(crate) mean_px: [f32; 2],
    /// `[p, q, r] = [a / 2, b, c / 2] log2(e)` for the inverse covariance `[a b; b c]`, 1/px². At an offset of
    /// `(dx, dy)` px from the mean, the *falloff* is `p dx² + q dx dy + r dy²` and alpha is
    /// `2^(log2_opacity - falloff)`.
    pub(crate) falloff: [f32; 3],
    pub(crate) log2_opacity: f32,
    pub(crate) rgb: [f32; 3],
    /// Normal of the splat's plane, camera frame.
    pub(crate) normal: [f32; 3],
    /// Distance of the splat's plane from the camera centre, world units.
    pub(crate) plane_distance: f32,
    /// Half the sides of the box around all pixels with an alpha of at least [`ALPHA_MIN`].
    pub(crate) extent_px: [f32; 2],
    /// Largest falloff at which alpha is at least [`ALPHA_MIN`]: `log2(255 o)` for opacity `o`.
    pub(crate) falloff_max: f32,
}

/// Results of the projection pass, by splat id.
#[derive(Debug, Default)]
pub(crate) struct Projection {
    pub(crate) splats: Vec<Projected>,
    /// Depth along the optical axis, world units.
    pub(crate) depths: Vec<f32>,
    /// Visible splats: bit `i` of entry `b` stands for splat `16 b + i`.
    pub(crate) visible: Vec<u16>,
}

impl Projection {
    pub(crate) fn with_capacity(capacity: usize) -> Self {
        let blocks = capacity.div_ceil(GROUP);
        Self {
            splats: Vec::with_capacity(blocks * GROUP),
            depths: Vec::with_capacity(blocks * GROUP),
            visible: Vec::with_capacity(blocks),
        }
    }

    /// Indices of the visible splats, ascending.
    pub(crate) fn visible(&self) -> impl Iterator<Item = usize> {
        let of_block = |(block, visible): (usize, &u16)| {
            let visible = *visible;
            (0..GROUP).filter(move |i| visible >> i & 1 == 1).map(move |i| block * GROUP + i)
        };
        self.visible.iter().enumerate().flat_map(of_block)
    }

    fn resize(&mut self, blocks: usize) {
        self.splats.resize(blocks * GROUP, Projected::default());
        self.depths.resize(blocks * GROUP, 0.0);
        self.visible.resize(blocks, 0);
    }
}

/// Projects all splats.
pub(crate) fn project(isa: Isa, params: &Blocks, view: &ViewParams, out: &mut Projection) {
    let blocks = params.len().div_ceil(GROUP);
    out.resize(blocks);
    let stride = params.stride();
    let tail_mask = |block: usize| match params.len() - block * GROUP {
        left if left < GROUP => (1u16 << left) - 1,
        _ => !0,
    };
    (params.rows().par_chunks_exact(stride))
        .zip(out.splats.par_chunks_exact_mut(GROUP))
        .zip(out.depths.par_chunks_exact_mut(GROUP))
        .zip(out.visible.par_iter_mut())
        .enumerate()
        .with_min_len(64)
        .for_each(|(index, (((block, splats), depths), visible))| {
            *visible = isa.run(ProjectBlock { block, view, splats, depths }) & tail_mask(index);
        });
}

struct ProjectBlock<'a> {
    block: &'a [Row],
    view: &'a ViewParams,
    splats: &'a mut [Projected],
    depths: &'a mut [f32],
}

/// Number of values in a [`Projected`]. The results of a block have one row for each value, and are then transposed.
const FIELDS: usize = 16;

impl Kernel for ProjectBlock<'_> {
    /// Bit mask of the visible splats.
    type Output = u16;

    #[inline(always)]
    fn run<L: Lanes>(self) -> u16 {
        let mut fields = [Row::ZERO; FIELDS];
        let mut in_front = 0u32;
        for part in 0..GROUP / L::N {
            let t_z = project_part::<L>(self.block, self.view, part, &mut fields);
            t_z.store(&mut self.depths[part * L::N..]);
            let is_in_range = L::bits(L::splat(NEAR).lt(t_z)) & !L::bits(L::splat(self.view.far).lt(t_z));
            in_front |= is_in_range << (part * L::N);
        }
        let mut visible = 0u16;
        for (i, splat) in self.splats.iter_mut().enumerate() {
            if in_front >> i & 1 == 1 && finish(splat, std::array::from_fn(|k| fields[k].0[i]), self.view) {
                visible |= 1 << i;
            }
        }
        visible
    }
}

/// Projects one vector of splats, without culling. Returns the depths.
#[inline(always)]
fn project_part<L: Lanes>(block: &[Row], view: &ViewParams, part: usize, fields: &mut [Row; FIELDS]) -> L {
    let get = |row: usize| block[row].get::<L>(part);
    let mean = [get(MEAN), get(MEAN + 1), get(MEAN + 2)];
    let quat = [get(QUAT), get(QUAT + 1), get(QUAT + 2), get(QUAT + 3)];
    let log_scale = [get(LOG_SCALE), get(LOG_SCALE + 1), get(LOG_SCALE + 2)];
    let g = geometry(mean, quat, log_scale, view);
    let plane = plane(&g, log_scale);
    let inv_det = L::splat(1.0) / g.det;
    let rgb = color(block, mean, view, part);
    let mean_px =
        each!([0, 1], |a| L::splat(view.focal_px[a]).mul_add(g.t[a] * g.inv_z, L::splat(view.center_px[a])));
    let (log2_e, zero) = (L::splat(LOG2_E), L::zero());
    // log2(sigmoid(x)), without overflow for large positive or negative x.
    let logit = get(OPACITY);
    let tail = logit.abs().neg().max(L::splat(-80.0)).exp().ln_1p();
    let log2_opacity = log2_e * (logit.min(zero) - tail);
    let falloff_max = log2_opacity - L::splat(libm::log2f(ALPHA_MIN));
    // At an offset d, m = ½ dᵀ C⁻¹ d = falloff / log2(e), with the covariance C. The ellipse up to a given m has a box
    // with half-sides sqrt(2 m C_xx) and sqrt(2 m C_yy). `reach` is 2 m.
    let reach = L::splat(2.0 / LOG2_E) * falloff_max.max(zero);
    let half = inv_det * L::splat(0.5 * LOG2_E);
    let values = [
        mean_px[0],
        mean_px[1],
        g.cov[2] * half,
        (g.cov[1] * inv_det * log2_e).neg(),
        g.cov[0] * half,
        log2_opacity,
        rgb[0],
        rgb[1],
        rgb[2],
        plane.normal[0],
        plane.normal[1],
        plane.normal[2],
        plane.distance,
        (reach * g.cov[0]).sqrt(),
        (reach * g.cov[2]).sqrt(),
        falloff_max,
    ];
    for (field, value) in fields.iter_mut().zip(values) {
        field.set(part, value);
    }
    g.t[2]
}

#[inline(always)]
fn color<L: Lanes>(block: &[Row], mean: [L; 3], view: &ViewParams, part: usize) -> [L; 3] {
    let (dir, _) = view_direction(mean, view);
    let basis = harmonics::basis(dir, view.sh_degree);
    let coefficients = cosurf_scene::splats::sh_coefficients(view.sh_degree);
    let mut rgb = [L::splat(0.5); 3];
    for (k, y) in basis.iter().enumerate().take(coefficients) {
        for (channel, value) in rgb.iter_mut().enumerate() {
            *value = block[SH + 3 * k + channel].get::<L>(part).mul_add(*y, *value);
        }
    }
    each!([0, 1, 2], |c| rgb[c].max(L::zero()))
}

/// Stores one splat. Returns false if the splat is not visible.
#[inline(always)]
fn finish(splat: &mut Projected, f: [f32; FIELDS], view: &ViewParams) -> bool {
    *splat = Projected {
        mean_px: [f[0], f[1]],
        falloff: [f[2], f[3], f[4]],
        log2_opacity: f[5],
        rgb: [f[6], f[7], f[8]],
        normal: [f[9], f[10], f[11]],
        plane_distance: f[12],
        extent_px: [f[13], f[14]],
        falloff_max: f[15],
    };
    let within = |axis: usize| {
        let (mean, extent) = (splat.mean_px[axis], splat.extent_px[axis]);
        mean + extent >= 0.5 && mean - extent <= view.size_px[axis] as f32 - 0.5
    };
    // Comparisons with NaN are false, so a splat with NaN is not visible.
    splat.falloff_max > 0.0 && within(0) && within(1)
}
