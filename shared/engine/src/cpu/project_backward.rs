//! The backward pass of the projection. It sums the records of each splat in a fixed order. Then it propagates the
//! gradients through the 2D Gaussian, the plane and the colour to the parameters. The formulas are the derivatives of
//! those in [`super::geometry`]. A variable `v_x` is ∂L/∂x, the gradient of the loss with respect to `x`.

use rayon::prelude::*;

use super::bin::TileLists;
use super::blocks::Blocks;
use super::geometry::{Geometry, geometry, plane, shortest_axis};
use super::project::{Projected, Projection};
use super::rasterize_backward::{ABSOLUTE, MOMENTS, V_DISTANCE, V_NORMAL, V_RGB};
use super::records::Record;
use crate::layout::harmonics::{self, view_direction};
use crate::layout::planes::PLANES_GEOMETRY;
use crate::layout::rows::{
    GRADIENT_RGB, GRADIENT_ROWS, LOG_SCALE, MEAN, OPACITY, QUAT, SH, STAT_ABSOLUTE_GRADIENT, STAT_ROWS,
    STAT_SCREEN_GRADIENT, STAT_VIEWS,
};
use crate::layout::view::ViewParams;
use crate::simd::{GROUP, Isa, Kernel, Lanes, Row, dot3, each, prefetch};

/// Inputs of the pass.
pub(crate) struct Inputs<'a> {
    pub(crate) params: &'a Blocks,
    pub(crate) view: &'a ViewParams,
    pub(crate) projection: &'a Projection,
    pub(crate) lists: &'a TileLists,
    pub(crate) records: &'a [Record],
    /// Number of rendered planes.
    pub(crate) planes: usize,
    /// Weight of the mean shortest scale of the visible splats.
    pub(crate) scale_weight: f32,
}

/// Computes new gradients for each block in which a splat is visible, and adds to the statistics. Other blocks keep old
/// gradients, which no pass reads.
pub(crate) fn project_backward(isa: Isa, inputs: &Inputs, gradients: &mut Blocks, stats: &mut Blocks) {
    let visible = inputs.projection.visible.iter().map(|bits| bits.count_ones()).sum::<u32>();
    let scale_weight = inputs.scale_weight / visible.max(1) as f32;
    gradients.resize(inputs.params.len());
    stats.resize(inputs.params.len());
    gradients
        .rows_mut()
        .par_chunks_exact_mut(GRADIENT_ROWS)
        .zip(stats.rows_mut().par_chunks_exact_mut(STAT_ROWS))
        .enumerate()
        .with_min_len(64)
        .for_each(|(block, (gradients, stats))| {
            let visible = inputs.projection.visible[block];
            if visible == 0 {
                return;
            }
            let sums = gather(inputs, block, visible);
            let geometry = inputs.planes == PLANES_GEOMETRY;
            let seen = inputs.params.block(block);
            let projected = &inputs.projection.splats[block * GROUP..][..GROUP];
            isa.run(BackwardBlock {
                block: seen,
                projected,
                view: inputs.view,
                sums: &sums,
                geometry,
                scale_weight,
                gradients,
                stats,
                visible,
            });
        });
}

/// Sums the records of each visible splat of a block and transposes the sums: row `k` holds sum `k` of the 16 splats.
fn gather(inputs: &Inputs, block: usize, visible: u16) -> [Row; GROUP] {
    let mut sums = [Row::ZERO; GROUP];
    let lanes = (0..GROUP).filter(|lane| visible >> lane & 1 == 1);
    // The records of a splat are scattered in memory, so all are prefetched before the first is used.
    for pair in lanes.clone().flat_map(|lane| inputs.lists.pairs_of(block * GROUP + lane)) {
        prefetch(inputs.records, pair);
    }
    for lane in lanes {
        let mut total = [0.0; GROUP];
        for pair in inputs.lists.pairs_of(block * GROUP + lane) {
            for (total, value) in total.iter_mut().zip(inputs.records[pair].0) {
                *total += value;
            }
        }
        for (sum, total) in sums.iter_mut().zip(total) {
            sum.0[lane] = total;
        }
    }
    sums
}

struct BackwardBlock<'a> {
    block: &'a [Row],
    projected: &'a [Projected],
    view: &'a ViewParams,
    sums: &'a [Row; GROUP],
    geometry: bool,
    /// Weight of the shortest scale of one splat: the weight of the mean, divided by the number of visible splats.
    scale_weight: f32,
    gradients: &'a mut [Row],
    stats: &'a mut [Row],
    visible: u16,
}

impl Kernel for BackwardBlock<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let mut shown = [Row::ZERO; 3];
        let mut seen = Row::ZERO;
        for lane in 0..GROUP {
            // A colour channel that is 0 was clamped, so it has no gradient.
            for (channel, row) in shown.iter_mut().enumerate() {
                row.0[lane] = f32::from(u8::from(self.projected[lane].rgb[channel] > 0.0));
            }
            seen.0[lane] = f32::from(self.visible >> lane & 1);
        }
        for part in 0..GROUP / L::N {
            let get = |row: usize| self.block[row].get::<L>(part);
            let sum = |k: usize| self.sums[k].get::<L>(part);
            let mean = [get(MEAN), get(MEAN + 1), get(MEAN + 2)];
            let log_scale = [get(LOG_SCALE), get(LOG_SCALE + 1), get(LOG_SCALE + 2)];
            let quat = [get(QUAT), get(QUAT + 1), get(QUAT + 2), get(QUAT + 3)];
            let g = geometry(mean, quat, log_scale, self.view);

            let screen = screen_gradients(&g, each!([0, 1, 2, 3, 4, 5], |k| sum(MOMENTS + k)));
            let mut into = CameraGradients { t: [L::zero(); 3], u: [[L::zero(); 3]; 3] };
            let mut v_log_scale = through_covariance(&g, self.view, screen.cov, &mut into);
            through_shortest(&g, log_scale, L::splat(self.scale_weight), &mut v_log_scale);
            through_mean(&g, self.view, screen.mean_px, &mut into);
            if self.geometry {
                let v_normal = each!([0, 1, 2], |k| sum(V_NORMAL + k));
                through_plane(&g, log_scale, v_normal, sum(V_DISTANCE), &mut into);
            }
            let v_rgb = each!([0, 1, 2], |c| sum(V_RGB + c) * shown[c].get::<L>(part));
            let from_sh = through_direction(self.block, part, mean, self.view, v_rgb);
            let (v_mean, v_quat) = to_world(&g, self.view, &into);
            // `sum(MOMENTS)` is ∂L/∂ln o for the opacity o, and ∂ln o / ∂logit = 1 - o.
            let v_opacity =
                sum(MOMENTS) / (L::splat(1.0) + get(OPACITY).max(L::splat(-80.0)).min(L::splat(80.0)).exp());

            let mut put = |row: usize, value: L| self.gradients[row].set(part, value);
            for axis in 0..3 {
                put(MEAN + axis, v_mean[axis] + from_sh[axis]);
                put(LOG_SCALE + axis, v_log_scale[axis]);
                put(GRADIENT_RGB + axis, v_rgb[axis]);
            }
            for (k, value) in v_quat.into_iter().enumerate() {
                put(QUAT + k, value);
            }
            put(OPACITY, v_opacity);
            let ln_2 = L::splat(std::f32::consts::LN_2);
            let absolute = [sum(ABSOLUTE) * ln_2, sum(ABSOLUTE + 1) * ln_2];
            let seen = seen.get::<L>(part);
            count_norm(self.stats, STAT_SCREEN_GRADIENT, part, &screen.mean_px, self.view, seen);
            count_norm(self.stats, STAT_ABSOLUTE_GRADIENT, part, &absolute, self.view, seen);
            let views = self.stats[STAT_VIEWS].get::<L>(part) + seen;
            self.stats[STAT_VIEWS].set(part, views);
        }
    }
}

struct ScreenGradients<L> {
    mean_px: [L; 2],
    /// Gradient with respect to the covariance, as a symmetric matrix (xx, xy, yy). `xy` is one of the two equal
    /// entries, not their sum.
    cov: [L; 3],
}

/// Gradients with respect to mean and covariance on the screen, from the sums at [`MOMENTS`]: `-A (Σq d)` and
/// `½ A (Σq d dᵀ) A`, with the inverse covariance `A`, `q = α ∂L/∂α` and `d = mean - pixel`.
#[inline(always)]
fn screen_gradients<L: Lanes>(g: &Geometry<L>, m: [L; 6]) -> ScreenGradients<L> {
    let inv_det = L::splat(1.0) / g.det;
    let (a, b, c) = (g.cov[2] * inv_det, (g.cov[1] * inv_det).neg(), g.cov[0] * inv_det);
    let [_, x, y, xx, xy, yy] = m;
    let half = L::splat(0.5);
    let p = [[a * xx + b * xy, a * xy + b * yy], [b * xx + c * xy, b * xy + c * yy]];
    ScreenGradients {
        mean_px: [(a * x + b * y).neg(), (b * x + c * y).neg()],
        cov: [
            half * (p[0][0] * a + p[0][1] * b),
            half * (p[0][0] * b + p[0][1] * c),
            half * (p[1][0] * b + p[1][1] * c),
        ],
    }
}

/// Gradients with respect to centre and axes in the camera frame.
struct CameraGradients<L> {
    t: [L; 3],
    u: [[L; 3]; 3],
}

/// Propagates the gradient of the covariance `C = B S² Bᵀ`, with the scales `S` and `B = J u`, to the axes `u` and the
/// centre `t`. Returns the gradients with respect to the log-scales.
#[inline(always)]
fn through_covariance<L: Lanes>(
    g: &Geometry<L>,
    view: &ViewParams,
    v_cov: [L; 3],
    into: &mut CameraGradients<L>,
) -> [L; 3] {
    let [xx, xy, yy] = v_cov;
    let two = L::splat(2.0);
    let scaled = each!([0, 1, 2], |k| two * g.variance[k]);
    let v_b = [
        each!([0, 1, 2], |k| scaled[k] * (xx * g.b[0][k] + xy * g.b[1][k])),
        each!([0, 1, 2], |k| scaled[k] * (xy * g.b[0][k] + yy * g.b[1][k])),
    ];
    for a in 0..2 {
        let j = L::splat(view.focal_px[a]) * g.inv_z;
        let v_slope = (j * dot3(v_b[a], g.u[2])).neg();
        // A row of `B` is b = j w with j = f / z and w = u[a] - slope u[2], so ∂L/∂j = v_b · w = v_b · b / j.
        let v_z_of_j = (dot3(v_b[a], g.b[a]) * g.inv_z).neg();
        let free = L::select(g.clamped[a], L::zero(), v_slope);
        into.t[a] = into.t[a] + free * g.inv_z;
        into.t[2] = into.t[2] + v_z_of_j - free * g.slope[a] * g.inv_z;
        for k in 0..3 {
            let v = j * v_b[a][k];
            into.u[a][k] = into.u[a][k] + v;
            into.u[2][k] = g.slope[a].neg_mul_add(v, into.u[2][k]);
        }
    }
    each!([0, 1, 2], |k| g.b[0][k] * v_b[0][k] + g.b[1][k] * v_b[1][k])
}

/// Propagates the gradient of the screen position `m = f t / z + c` to the centre `t`. Here the slope `t / z` is not
/// clamped.
#[inline(always)]
fn through_mean<L: Lanes>(
    g: &Geometry<L>,
    view: &ViewParams,
    v_mean_px: [L; 2],
    into: &mut CameraGradients<L>,
) {
    for (a, v) in v_mean_px.into_iter().enumerate() {
        let scaled = v * L::splat(view.focal_px[a]) * g.inv_z;
        into.t[a] = into.t[a] + scaled;
        into.t[2] = into.t[2] - scaled * g.t[a] * g.inv_z;
    }
}

/// Propagates the gradients of the normal `n = ± u[axis]` and of the distance `D = -n · t` to the axes `u` and the
/// centre `t`.
#[inline(always)]
fn through_plane<L: Lanes>(
    g: &Geometry<L>,
    log_scale: [L; 3],
    v_normal: [L; 3],
    v_distance: L,
    into: &mut CameraGradients<L>,
) {
    let plane = plane(g, log_scale);
    for r in 0..3 {
        let v_n = v_distance.neg_mul_add(g.t[r], v_normal[r]) * plane.sign;
        into.t[r] = v_distance.neg_mul_add(plane.normal[r], into.t[r]);
        for axis in 0..3 {
            into.u[r][axis] = into.u[r][axis] + v_n.keep(plane.axis[axis]);
        }
    }
}

/// Adds the gradient of the scale loss, which is `weight · s` for the scale `s` of the shortest axis. Its derivative
/// with respect to `ln s` is `weight · s` too.
#[inline(always)]
fn through_shortest<L: Lanes>(g: &Geometry<L>, log_scale: [L; 3], weight: L, into: &mut [L; 3]) {
    let shortest = shortest_axis(log_scale);
    for k in 0..3 {
        into[k] = into[k] + (weight * g.variance[k].sqrt()).keep(shortest[k]);
    }
}

/// The gradient with respect to the mean that comes from the colour, because the colour depends on the viewing
/// direction.
#[inline(always)]
fn through_direction<L: Lanes>(
    block: &[Row],
    part: usize,
    mean: [L; 3],
    view: &ViewParams,
    v_rgb: [L; 3],
) -> [L; 3] {
    let (dir, inv_length) = view_direction(mean, view);
    let mut weights = [L::zero(); 16];
    let coefficients = cosurf_scene::splats::sh_coefficients(view.sh_degree);
    for (k, weight) in weights.iter_mut().enumerate().take(coefficients).skip(1) {
        *weight = dot3(each!([0, 1, 2], |c| block[SH + 3 * k + c].get::<L>(part)), v_rgb);
    }
    let v_dir = harmonics::weighted_gradient(dir, view.sh_degree, &weights);
    let along = dot3(dir, v_dir);
    each!([0, 1, 2], |a| (v_dir[a] - dir[a] * along) * inv_length)
}

/// Converts gradients in the camera frame to gradients with respect to the mean and to the quaternion (wxyz, before its
/// normalisation).
#[inline(always)]
fn to_world<L: Lanes>(g: &Geometry<L>, view: &ViewParams, from: &CameraGradients<L>) -> ([L; 3], [L; 4]) {
    let w = each!([0, 1, 2], |r| each!([0, 1, 2], |a| L::splat(view.rotation[r][a])));
    let column = |c: usize| [w[0][c], w[1][c], w[2][c]];
    let v_mean = each!([0, 1, 2], |c| dot3(column(c), from.t));
    let m = each!([0, 1, 2], |r| each!([0, 1, 2], |axis| {
        dot3(column(r), [from.u[0][axis], from.u[1][axis], from.u[2][axis]])
    }));
    let [qw, x, y, z] = g.q;
    let two = L::splat(2.0);
    let v = [
        two * dot3([x, y, z], [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]]),
        two * (dot3([y, z, qw], [m[0][1] + m[1][0], m[0][2] + m[2][0], m[2][1] - m[1][2]])
            - two * x * (m[1][1] + m[2][2])),
        two * (dot3([x, z, qw], [m[0][1] + m[1][0], m[1][2] + m[2][1], m[0][2] - m[2][0]])
            - two * y * (m[0][0] + m[2][2])),
        two * (dot3([x, y, qw], [m[0][2] + m[2][0], m[1][2] + m[2][1], m[1][0] - m[0][1]])
            - two * z * (m[0][0] + m[1][1])),
    ];
    let along = dot3([v[0], v[1], v[2]], [qw, x, y]) + v[3] * z;
    let v_quat = each!([0, 1, 2, 3], |k| (v[k] - g.q[k] * along) * g.inv_norm);
    (v_mean, v_quat)
}

/// Adds the norm of `v_px` to the statistics of visible splats. `v_px` is a gradient with respect to the screen
/// position in px; first it is converted to positions in units of half the picture.
#[inline(always)]
fn count_norm<L: Lanes>(
    stats: &mut [Row],
    stat: usize,
    part: usize,
    v_px: &[L; 2],
    view: &ViewParams,
    seen: L,
) {
    let half = each!([0, 1], |a| L::splat(0.5 * view.size_px[a] as f32));
    let v = [v_px[0] * half[0], v_px[1] * half[1]];
    let norm = (v[0] * v[0] + v[1] * v[1]).sqrt();
    // Lanes of splats that are not visible may hold NaN.
    let norm = L::select(L::splat(0.5).lt(seen), norm, L::zero());
    let sum = stats[stat].get::<L>(part) + norm;
    stats[stat].set(part, sum);
}
