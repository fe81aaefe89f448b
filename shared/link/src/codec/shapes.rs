//! Quantises and dequantises the shapes of splats: position, rotation, scale, opacity and base colour.

use cosurf_scene::Splats;
use cosurf_wire::body::{
    COLOR_STEP, LOG_SCALE_MAX, LOG_SCALE_STEP, OPACITY_STEP, QUAT_ZERO, STEP_EXPONENTS, Shape, ShapeFrame,
    THICKNESS_STEP,
};
use glam::{Mat3, Quat};

/// The position step of a pack is at most the middle axis of its median splat divided by this number.
/// Rounding then moves a splat by less than a thirtieth of that axis along each coordinate. The step is
/// larger if the pack is too wide for 16-bit positions.
const STEPS_PER_SCALE: f32 = 16.0;
/// Opacity logits are clamped to this magnitude: an opacity of 0.9997. The rasteriser clamps at 0.99 in any
/// case.
const OPACITY_LOGIT_MAX: f32 = 8.0;

/// Positions of base splats are multiples of this many position steps. Base splats are quantised more
/// coarsely than others, because each stands in for several splats: this saves bytes at a small loss of
/// quality.
const BASE_POSITION_STEPS: u16 = 2;
/// Quaternion components of base splats are multiples of this many quaternion steps.
const BASE_QUAT_STEPS: u16 = 16;

/// A splat without its view-dependent colour, in `f32` numbers. [`Shape`] is its quantised form.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FloatShape {
    pub(super) mean: [f32; 3],
    pub(super) quat: [f32; 4],
    pub(super) log_scale: [f32; 3],
    pub(super) opacity_logit: f32,
    pub(super) color: [f32; 3],
}

impl FloatShape {
    /// The shape of splat `i`.
    pub(super) fn of(splats: &Splats, i: usize) -> Self {
        let sh = splats.sh_of(i);
        Self {
            mean: splats.means[i],
            quat: splats.quats[i],
            log_scale: splats.log_scales[i],
            opacity_logit: splats.opacity_logits[i],
            color: [sh[0], sh[1], sh[2]],
        }
    }
}

/// Chooses the reference values ([`ShapeFrame`]) for a pack of `splats`, which must not be empty.
pub(super) fn choose_frame(splats: &[FloatShape]) -> ShapeFrame {
    let corner = |fold: fn(f32, f32) -> f32, start: f32| {
        splats
            .iter()
            .fold([start; 3], |corner, splat| std::array::from_fn(|k| fold(corner[k], splat.mean[k])))
    };
    let (min, max) = (corner(f32::min, f32::INFINITY), corner(f32::max, f32::NEG_INFINITY));
    let extent = (0..3).map(|k| f64::from(max[k]) - f64::from(min[k])).fold(0.0, f64::max);
    let mut scales: Vec<[f32; 3]> = splats.iter().map(|splat| sorted(splat.log_scale)).collect();
    let largest = scales.iter().map(|scale| scale[0]).fold(f32::NEG_INFINITY, f32::max);
    let smallest = scales.iter().map(|scale| scale[0]).fold(f32::INFINITY, f32::min);
    let middle = scales.len() / 2;
    let median = scales.select_nth_unstable_by(middle, |a, b| a[1].total_cmp(&b[1])).1[1];
    let (finest, coarsest) = (i32::from(*STEP_EXPONENTS.start()), i32::from(*STEP_EXPONENTS.end()));
    let wanted = (libm::log2f(libm::expf(median) / STEPS_PER_SCALE).floor() as i32).clamp(finest, coarsest);
    let steps_max = f64::from(u16::MAX - BASE_POSITION_STEPS);
    let fits = |exponent: &i32| extent <= steps_max * libm::exp2(f64::from(*exponent));
    ShapeFrame {
        origin: min,
        log_scale: smallest.max(largest - 255.0 * LOG_SCALE_STEP).clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX),
        step_exponent: (wanted..coarsest).find(fits).unwrap_or(coarsest) as i8,
    }
}

/// Quantises a splat.
pub(super) fn quantise(frame: &ShapeFrame, splat: &FloatShape) -> Shape {
    quantise_in_steps(frame, splat, [1, 1])
}

/// Quantises a splat of the base.
pub(super) fn quantise_base(frame: &ShapeFrame, splat: &FloatShape) -> Shape {
    quantise_in_steps(frame, splat, [BASE_POSITION_STEPS, BASE_QUAT_STEPS])
}

/// Quantises a splat. Positions and quaternion components become multiples of the given numbers of steps.
fn quantise_in_steps(
    frame: &ShapeFrame,
    splat: &FloatShape,
    [position_steps, quat_steps]: [u16; 2],
) -> Shape {
    let order = axis_order(splat.log_scale);
    let log_scale = order.map(|axis| splat.log_scale[axis]);
    let per_unit = libm::exp2(f64::from(-frame.step_exponent)) / f64::from(position_steps);
    let position = std::array::from_fn(|k| {
        let offset = f64::from(splat.mean[k]) - f64::from(frame.origin[k]);
        (offset * per_unit).round() as u16 * position_steps
    });
    let quat_zero = f32::from(QUAT_ZERO);
    let quat = canonical_quat(splat.quat, order).map(|v| {
        let steps = v / std::f32::consts::FRAC_1_SQRT_2 * quat_zero / f32::from(quat_steps);
        (quat_zero + steps.round() * f32::from(quat_steps)).clamp(0.0, 2.0 * quat_zero) as u16
    });
    let scale_steps = |difference: f32| (difference / LOG_SCALE_STEP).round().clamp(0.0, 255.0);
    // Each log scale is measured from the quantised value of the previous one, so that errors do not add up.
    let first = scale_steps(log_scale[0] - frame.log_scale);
    let at_first = frame.log_scale + first * LOG_SCALE_STEP;
    let second = scale_steps(at_first - log_scale[1]);
    let thickness = libm::expf(log_scale[2] - at_first + second * LOG_SCALE_STEP).min(1.0) / THICKNESS_STEP;
    let logit = splat.opacity_logit.clamp(-OPACITY_LOGIT_MAX, OPACITY_LOGIT_MAX);
    Shape {
        position,
        quat,
        log_scale: [first as u8, second as u8],
        thickness: thickness.round() as u8,
        opacity: (logit / OPACITY_STEP).round() as i8,
        color: splat.color.map(|v| (v / COLOR_STEP).round() as i16),
    }
}

/// Dequantises a splat. Any integers give a valid splat.
pub(super) fn dequantise(frame: &ShapeFrame, shape: &Shape) -> FloatShape {
    let step = libm::exp2(f64::from(frame.step_exponent));
    let mean =
        std::array::from_fn(|k| (f64::from(frame.origin[k]) + f64::from(shape.position[k]) * step) as f32);
    let [x, y, z] =
        shape.quat.map(|v| (f32::from(v) / f32::from(QUAT_ZERO) - 1.0) * std::f32::consts::FRAC_1_SQRT_2);
    let w = (1.0 - x * x - y * y - z * z).max(0.0).sqrt();
    let [first, second] = shape.log_scale.map(f32::from);
    let largest = frame.log_scale + first * LOG_SCALE_STEP;
    let middle = largest - second * LOG_SCALE_STEP;
    // The thickness is kept a quarter of a step away from both ends of its range, 0 and 1. A flat splat then
    // keeps some thickness. A sphere keeps a shortest axis, which serves as its normal.
    let thickness = f32::from(shape.thickness).min(THICKNESS_STEP.recip() - 0.25).max(0.25) * THICKNESS_STEP;
    FloatShape {
        mean,
        quat: [w, x, y, z],
        log_scale: [largest, middle, middle + libm::logf(thickness)]
            .map(|v| v.clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX)),
        opacity_logit: f32::from(shape.opacity) * OPACITY_STEP,
        color: shape.color.map(|v| f32::from(v) * COLOR_STEP),
    }
}

/// Returns the log scales in falling order.
fn sorted(log_scale: [f32; 3]) -> [f32; 3] {
    let order = axis_order(log_scale);
    order.map(|axis| log_scale[axis])
}

/// Returns the indices of the axes in order of falling log scale.
fn axis_order(log_scale: [f32; 3]) -> [usize; 3] {
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| log_scale[b].total_cmp(&log_scale[a]));
    order
}

/// Describes the ellipsoid of a quaternion with its axes in another order: the old axes `first` and `second` become the
/// first and the second. Returns x, y and z of a unit quaternion whose w is positive and has the largest magnitude of
/// the four components. Such a quaternion always exists. A half-turn about an axis does not change the ellipsoid, so
/// four quaternions (not counting signs) describe it. All four have the same magnitudes, each in another order: every
/// magnitude is that of w in one of the four.
fn canonical_quat([w, x, y, z]: [f32; 4], [first, second, _]: [usize; 3]) -> [f32; 3] {
    let old = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
    let (a, b) = (old.col(first), old.col(second));
    let q = Quat::from_mat3(&Mat3::from_cols(a, b, a.cross(b)));
    let half_turns =
        [[q.w, q.x, q.y, q.z], [-q.x, q.w, q.z, -q.y], [-q.y, -q.z, q.w, q.x], [-q.z, q.y, -q.x, q.w]];
    let best = half_turns.into_iter().reduce(|best, q| if q[0].abs() > best[0].abs() { q } else { best });
    let [w, x, y, z] = best.unwrap_or_default();
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    [x, y, z].map(|v| v * sign)
}
