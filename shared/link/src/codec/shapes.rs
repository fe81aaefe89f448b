//! Shapes of splats to whole numbers and back.

use cosurf_scene::Splats;
use cosurf_wire::body::{
    COLOR_STEP, LOG_SCALE_MAX, LOG_SCALE_STEP, OPACITY_STEP, QUAT_ZERO, STEP_EXPONENTS, Shape, ShapeFrame,
    THICKNESS_STEP,
};
use glam::{Mat3, Quat};

/// Steps of a position in the middle axis of a pack's median splat, at least: an error below a thirtieth.
const STEPS_PER_SCALE: f32 = 16.0;
/// An opacity logit beyond this is taken for this: 0.9997, where the rasteriser stops at 0.99.
const OPACITY_LOGIT_MAX: f32 = 8.0;

/// In the base positions go in steps of so many, and parts of the quaternion: what stands in for three splats need not
/// be told as finely as one of them. A base splat takes 9 bytes so, and 11.5 without, at 0.1 dB.
const BASE_POSITION_STEPS: u16 = 2;
const BASE_QUAT_STEPS: u16 = 16;

/// A splat but for what its colour does with the direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Form {
    pub(super) mean: [f32; 3],
    pub(super) quat: [f32; 4],
    pub(super) log_scale: [f32; 3],
    pub(super) opacity_logit: f32,
    pub(super) color: [f32; 3],
}

impl Form {
    /// That of splat `i`.
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

/// The frame of `forms`, of which there is at least one.
pub(super) fn frame(forms: &[Form]) -> ShapeFrame {
    let corner = |fold: fn(f32, f32) -> f32, start: f32| {
        forms.iter().fold([start; 3], |corner, form| std::array::from_fn(|k| fold(corner[k], form.mean[k])))
    };
    let (min, max) = (corner(f32::min, f32::INFINITY), corner(f32::max, f32::NEG_INFINITY));
    let extent = (0..3).map(|k| f64::from(max[k]) - f64::from(min[k])).fold(0.0, f64::max);
    let mut scales: Vec<[f32; 3]> = forms.iter().map(|form| sorted(form.log_scale)).collect();
    let largest = scales.iter().map(|scale| scale[0]).fold(f32::NEG_INFINITY, f32::max);
    let smallest = scales.iter().map(|scale| scale[0]).fold(f32::INFINITY, f32::min);
    let middle = scales.len() / 2;
    let median = scales.select_nth_unstable_by(middle, |a, b| a[1].total_cmp(&b[1])).1[1];
    let (finest, coarsest) = (i32::from(*STEP_EXPONENTS.start()), i32::from(*STEP_EXPONENTS.end()));
    let wanted = ((median.exp() / STEPS_PER_SCALE).log2().floor() as i32).clamp(finest, coarsest);
    let steps_max = f64::from(u16::MAX - BASE_POSITION_STEPS);
    let fits = |exponent: &i32| extent <= steps_max * f64::from(*exponent).exp2();
    ShapeFrame {
        origin: min,
        log_scale: smallest.max(largest - 255.0 * LOG_SCALE_STEP).clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX),
        step_exponent: (wanted..coarsest).find(fits).unwrap_or(coarsest) as i8,
    }
}

/// A splat in whole numbers.
pub(super) fn round(frame: &ShapeFrame, form: &Form) -> Shape {
    let order = axis_order(form.log_scale);
    round_as(frame, form, order, order.map(|axis| form.log_scale[axis]), [1, 1])
}

/// A splat of the base in whole numbers.
pub(super) fn round_base(frame: &ShapeFrame, form: &Form) -> Shape {
    let order = axis_order(form.log_scale);
    let scale = order.map(|axis| form.log_scale[axis]);
    round_as(frame, form, order, scale, [BASE_POSITION_STEPS, BASE_QUAT_STEPS])
}

/// With `scale` along the axes in `order`, positions and quaternions in multiples of some steps.
fn round_as(
    frame: &ShapeFrame,
    form: &Form,
    order: [usize; 3],
    scale: [f32; 3],
    [position_steps, quat_steps]: [u16; 2],
) -> Shape {
    let per_unit = f64::from(-frame.step_exponent).exp2() / f64::from(position_steps);
    let position = std::array::from_fn(|k| {
        let way = f64::from(form.mean[k]) - f64::from(frame.origin[k]);
        (way * per_unit).round() as u16 * position_steps
    });
    let quat_zero = f32::from(QUAT_ZERO);
    let quat = canonical(form.quat, order).map(|v| {
        let way = v / std::f32::consts::FRAC_1_SQRT_2 * quat_zero / f32::from(quat_steps);
        (quat_zero + way.round() * f32::from(quat_steps)).clamp(0.0, 2.0 * quat_zero) as u16
    });
    let steps = |way: f32| (way / LOG_SCALE_STEP).round().clamp(0.0, 255.0);
    // Each is measured from what the one before was rounded to, so errors do not add up.
    let first = steps(scale[0] - frame.log_scale);
    let at_first = frame.log_scale + first * LOG_SCALE_STEP;
    let second = steps(at_first - scale[1]);
    let thickness = (scale[2] - at_first + second * LOG_SCALE_STEP).exp().min(1.0) / THICKNESS_STEP;
    let logit = form.opacity_logit.clamp(-OPACITY_LOGIT_MAX, OPACITY_LOGIT_MAX);
    Shape {
        position,
        quat,
        log_scale: [first as u8, second as u8],
        thickness: thickness.round() as u8,
        opacity: (logit / OPACITY_STEP).round() as i8,
        color: form.color.map(|v| (v / COLOR_STEP).round() as i16),
    }
}

/// A splat from whole numbers; whatever they are, it can be rendered.
pub(super) fn unround(frame: &ShapeFrame, shape: &Shape) -> Form {
    let step = f64::from(frame.step_exponent).exp2();
    let mean =
        std::array::from_fn(|k| (f64::from(frame.origin[k]) + f64::from(shape.position[k]) * step) as f32);
    let [x, y, z] =
        shape.quat.map(|v| (f32::from(v) / f32::from(QUAT_ZERO) - 1.0) * std::f32::consts::FRAC_1_SQRT_2);
    let w = (1.0 - x * x - y * y - z * z).max(0.0).sqrt();
    let [first, second] = shape.log_scale.map(f32::from);
    let largest = frame.log_scale + first * LOG_SCALE_STEP;
    let middle = largest - second * LOG_SCALE_STEP;
    // A quarter of a step from either end: a flat splat has some thickness, and a ball still has a least axis,
    // for that is its normal.
    let thickness = f32::from(shape.thickness).min(THICKNESS_STEP.recip() - 0.25).max(0.25) * THICKNESS_STEP;
    Form {
        mean,
        quat: [w, x, y, z],
        log_scale: [largest, middle, middle + thickness.ln()].map(|v| v.clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX)),
        opacity_logit: f32::from(shape.opacity) * OPACITY_STEP,
        color: shape.color.map(|v| f32::from(v) * COLOR_STEP),
    }
}

/// Log scales in falling order.
fn sorted(log_scale: [f32; 3]) -> [f32; 3] {
    let order = axis_order(log_scale);
    order.map(|axis| log_scale[axis])
}

fn axis_order(log_scale: [f32; 3]) -> [usize; 3] {
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| log_scale[b].total_cmp(&log_scale[a]));
    order
}

/// The xyz of a unit quaternion whose w is the largest component and positive, which turns the same ellipsoid with its
/// axes in `order`. A half-turn about an axis changes nothing: of the four quaternions that differ by one, each
/// component is the w of one.
fn canonical([w, x, y, z]: [f32; 4], [first, second, _]: [usize; 3]) -> [f32; 3] {
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
