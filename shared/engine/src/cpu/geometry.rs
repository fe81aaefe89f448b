//! Computes a splat's 2D Gaussian and plane from its parameters, for the projection and its backward pass. The 2D
//! Gaussian is that of 3DGS (EWA splatting), the plane that of PGSR.

use crate::layout::constants::LOW_PASS_PX2;
use crate::layout::view::ViewParams;
use crate::simd::{Lanes, dot3, each};

/// Intermediate results between the parameters of splats and their 2D Gaussians.
#[derive(Clone, Copy)]
pub(crate) struct Geometry<L: Lanes> {
    /// Centre of the splat, camera frame.
    pub(crate) t: [L; 3],
    /// 1 / `t[2]`.
    pub(crate) inv_z: L,
    /// Slopes `x / z` and `y / z` of the centre, clamped to the limits of [`ViewParams`].
    pub(crate) slope: [L; 2],
    /// True where a slope was clamped.
    pub(crate) clamped: [L::Mask; 2],
    /// Unit quaternion, wxyz.
    pub(crate) q: [L; 4],
    /// 1 / length of the quaternion before normalisation.
    pub(crate) inv_norm: L,
    /// Rotation `cam_from_splat`, as `u[row][axis]`.
    pub(crate) u: [[L; 3]; 3],
    /// Variances along the splat's axes.
    pub(crate) variance: [L; 3],
    /// The splat's axes on the screen: `J u`, as `b[screen axis][axis]`, with the Jacobian `J` of the projection.
    pub(crate) b: [[L; 3]; 2],
    /// Covariance on the screen (xx, xy, yy), with the variance of the low-pass filter, px².
    pub(crate) cov: [L; 3],
    /// Determinant of `cov`, px⁴.
    pub(crate) det: L,
}

/// Rotation `world_from_splat` of a unit quaternion, as `r[row][axis]`.
#[inline(always)]
pub(crate) fn rotation<L: Lanes>(q: [L; 4]) -> [[L; 3]; 3] {
    let [w, x, y, z] = q;
    let (one, two) = (L::splat(1.0), L::splat(2.0));
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, xz, yz) = (x * y, x * z, y * z);
    let (wx, wy, wz) = (w * x, w * y, w * z);
    [
        [one - two * (yy + zz), two * (xy - wz), two * (xz + wy)],
        [two * (xy + wz), one - two * (xx + zz), two * (yz - wx)],
        [two * (xz - wy), two * (yz + wx), one - two * (xx + yy)],
    ]
}

#[inline(always)]
pub(crate) fn geometry<L: Lanes>(
    mean: [L; 3],
    quat: [L; 4],
    log_scale: [L; 3],
    view: &ViewParams,
) -> Geometry<L> {
    let c = L::splat;
    let one = c(1.0);
    let w = each!([0, 1, 2], |r| each!([0, 1, 2], |a| c(view.rotation[r][a])));
    let t = each!([0, 1, 2], |r| dot3(w[r], mean) + c(view.translation[r]));
    let inv_z = one / t[2];
    let raw = [t[0] * inv_z, t[1] * inv_z];
    let slope = each!([0, 1], |a| raw[a].max(c(view.slope_min[a])).min(c(view.slope_max[a])));
    let clamped =
        each!([0, 1], |a| L::and_not(L::mask_all(true), L::and(raw[a].ge(slope[a]), slope[a].ge(raw[a]))));

    let norm2 = quat[0].mul_add(quat[0], dot3([quat[1], quat[2], quat[3]], [quat[1], quat[2], quat[3]]));
    let inv_norm = one / norm2.sqrt();
    let q = each!([0, 1, 2, 3], |k| quat[k] * inv_norm);
    let r = rotation(q);
    let u =
        each!([0, 1, 2], |row| each!([0, 1, 2], |axis| dot3(w[row], [r[0][axis], r[1][axis], r[2][axis]])));
    let scale = each!([0, 1, 2], |k| log_scale[k].max(c(-40.0)).min(c(40.0)).exp());
    let variance = each!([0, 1, 2], |k| scale[k] * scale[k]);

    // Rows of `J u`. The rows of the Jacobian are `[f / z, 0, -f slope / z]` for x and `[0, f / z, -f slope / z]` for
    // y.
    let b = each!([0, 1], |a| {
        let j = c(view.focal_px[a]) * inv_z;
        each!([0, 1, 2], |axis| j * slope[a].neg_mul_add(u[2][axis], u[a][axis]))
    });
    let cov_of = |p: [L; 3], q: [L; 3]| dot3([p[0] * variance[0], p[1] * variance[1], p[2] * variance[2]], q);
    let low_pass = c(LOW_PASS_PX2);
    let bare = [cov_of(b[0], b[0]), cov_of(b[0], b[1]), cov_of(b[1], b[1])];
    // With the rows `s[0]` and `s[1]` of `S` (axes on the screen times scales), the variance λ of the low-pass filter
    // and the trace tr of `S Sᵀ`: det(S Sᵀ + λ I) = |s[0] × s[1]|² + λ tr + λ². Unlike xx yy - xy², this has no
    // cancellation for very thin splats.
    let s = each!([0, 1], |a| each!([0, 1, 2], |axis| b[a][axis] * scale[axis]));
    let cross = [
        s[0][1] * s[1][2] - s[0][2] * s[1][1],
        s[0][2] * s[1][0] - s[0][0] * s[1][2],
        s[0][0] * s[1][1] - s[0][1] * s[1][0],
    ];
    let det = dot3(cross, cross) + low_pass * (bare[0] + bare[2] + low_pass);
    let cov = [bare[0] + low_pass, bare[1], bare[2] + low_pass];
    Geometry { t, inv_z, slope, clamped, q, inv_norm, u, variance, b, cov, det }
}

/// The plane of a splat. Its normal is the shortest axis of the splat, turned towards the camera.
#[derive(Clone, Copy)]
pub(crate) struct Plane<L: Lanes> {
    /// Unit normal `n` in the camera frame, with `n · t <= 0` for the centre `t` of the splat.
    pub(crate) normal: [L; 3],
    /// Distance of the plane from the camera centre, at least 0, world units.
    pub(crate) distance: L,
    /// The shortest axis, as masks: in each lane, exactly one is true.
    pub(crate) axis: [L::Mask; 3],
    /// +1 or -1: the sign of the normal relative to the axis.
    pub(crate) sign: L,
}

/// The shortest axis, as masks: in each lane, exactly one is true. Of equally short axes it is the last.
#[inline(always)]
pub(crate) fn shortest_axis<L: Lanes>(log_scale: [L; 3]) -> [L::Mask; 3] {
    let [s0, s1, s2] = log_scale;
    let first = L::and(s0.lt(s1), s0.lt(s2));
    let second = L::and_not(s1.lt(s2), first);
    let third = L::and_not(L::and_not(L::mask_all(true), first), second);
    [first, second, third]
}

#[inline(always)]
pub(crate) fn plane<L: Lanes>(g: &Geometry<L>, log_scale: [L; 3]) -> Plane<L> {
    let [first, second, third] = shortest_axis(log_scale);
    let column = each!([0, 1, 2], |r| L::select(first, g.u[r][0], L::select(second, g.u[r][1], g.u[r][2])));
    let facing = dot3(column, g.t);
    let sign = L::select(facing.ge(L::zero()), L::splat(-1.0), L::splat(1.0));
    let normal = each!([0, 1, 2], |r| column[r] * sign);
    Plane { normal, distance: (facing * sign).neg(), axis: [first, second, third], sign }
}
