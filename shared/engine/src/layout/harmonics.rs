//! Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS.

use cosurf_scene::splats::sh_coefficients;

use super::view::ViewParams;
use crate::simd::{GROUP, Lanes, Plain, dot3, each};

pub(crate) const C0: f32 = cosurf_scene::splats::SH_C0;
pub(crate) const C1: f32 = 0.488_602_52;
pub(crate) const C2: [f32; 5] = [1.092_548_5, -1.092_548_5, 0.315_391_57, -1.092_548_5, 0.546_274_2];
pub(crate) const C3: [f32; 7] =
    [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_34, -0.457_045_8, 1.445_305_7, -0.590_043_6];

/// Values of the basis functions for unit directions; entries above `degree` are zero.
#[inline(always)]
pub(crate) fn basis<L: Lanes>(dir: [L; 3], degree: u32) -> [L; 16] {
    let [x, y, z] = dir;
    let c = L::splat;
    let mut b = [L::zero(); 16];
    b[0] = c(C0);
    if degree == 0 {
        return b;
    }
    b[1] = c(-C1) * y;
    b[2] = c(C1) * z;
    b[3] = c(-C1) * x;
    if degree == 1 {
        return b;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    b[4] = c(C2[0]) * x * y;
    b[5] = c(C2[1]) * y * z;
    b[6] = c(C2[2]) * (zz + zz - xx - yy);
    b[7] = c(C2[3]) * x * z;
    b[8] = c(C2[4]) * (xx - yy);
    if degree == 2 {
        return b;
    }
    let four_zz = c(4.0) * zz;
    b[9] = c(C3[0]) * y * (c(3.0) * xx - yy);
    b[10] = c(C3[1]) * x * y * z;
    b[11] = c(C3[2]) * y * (four_zz - xx - yy);
    b[12] = c(C3[3]) * z * (zz + zz - c(3.0) * (xx + yy));
    b[13] = c(C3[4]) * x * (four_zz - xx - yy);
    b[14] = c(C3[5]) * z * (xx - yy);
    b[15] = c(C3[6]) * x * (xx - c(3.0) * yy);
    b
}

/// `Σ_k w[k] ∇basis_k` at a unit direction. The caller must remove the part along the direction, because directions
/// only move on the sphere.
#[inline(always)]
pub(crate) fn weighted_gradient<L: Lanes>(dir: [L; 3], degree: u32, w: &[L; 16]) -> [L; 3] {
    let [x, y, z] = dir;
    let c = L::splat;
    let mut g = [L::zero(); 3];
    if degree == 0 {
        return g;
    }
    g[0] = c(-C1) * w[3];
    g[1] = c(-C1) * w[1];
    g[2] = c(C1) * w[2];
    if degree == 1 {
        return g;
    }
    let w4 = c(C2[0]) * w[4];
    let w5 = c(C2[1]) * w[5];
    let w6 = c(2.0 * C2[2]) * w[6];
    let w7 = c(C2[3]) * w[7];
    let w8 = c(2.0 * C2[4]) * w[8];
    g[0] = g[0] + w4 * y + w7 * z + (w8 - w6) * x;
    g[1] = g[1] + w4 * x + w5 * z - (w8 + w6) * y;
    g[2] = g[2] + w5 * y + w7 * x + c(2.0) * w6 * z;
    if degree == 2 {
        return g;
    }
    let (xx, yy, zz, xy, xz, yz) = (x * x, y * y, z * z, x * y, x * z, y * z);
    let w9 = c(C3[0]) * w[9];
    let w10 = c(C3[1]) * w[10];
    let w11 = c(C3[2]) * w[11];
    let w12 = c(C3[3]) * w[12];
    let w13 = c(C3[4]) * w[13];
    let w14 = c(C3[5]) * w[14];
    let w15 = c(C3[6]) * w[15];
    let (two, three, four, six, eight) = (c(2.0), c(3.0), c(4.0), c(6.0), c(8.0));
    g[0] = g[0] + six * w9 * xy + w10 * yz - two * w11 * xy - six * w12 * xz
        + w13 * (four * zz - three * xx - yy)
        + two * w14 * xz
        + three * w15 * (xx - yy);
    g[1] = g[1] + three * w9 * (xx - yy) + w10 * xz + w11 * (four * zz - xx - three * yy)
        - six * w12 * yz
        - two * w13 * xy
        - two * w14 * yz
        - six * w15 * xy;
    g[2] = g[2]
        + w10 * xy
        + eight * w11 * yz
        + w12 * (six * zz - three * (xx + yy))
        + eight * w13 * xz
        + w14 * (xx - yy);
    g
}

/// Unit directions from the camera to the splats, and 1 / distance.
#[inline(always)]
pub(crate) fn view_direction<L: Lanes>(mean: [L; 3], view: &ViewParams) -> ([L; 3], L) {
    let delta = each!([0, 1, 2], |a| mean[a] - L::splat(view.eye[a]));
    let inv_length = L::splat(1.0) / dot3(delta, delta).max(L::splat(1e-20)).sqrt();
    (each!([0, 1, 2], |a| delta[a] * inv_length), inv_length)
}

/// Gradients of a splat's SH coefficients: `v_rgb`, which is ∂L/∂rgb, times the basis in the direction from `view` to
/// the splat. Coefficients above the view's degree have gradient zero.
pub(crate) fn sh_gradients(mean: [f32; 3], v_rgb: [f32; 3], view: &ViewParams, sh_degree: u32) -> Vec<f32> {
    let (dir, _) = view_direction(mean.map(Plain::splat), view);
    let basis = basis(dir, view.sh_degree);
    let mut sh = vec![0.0; 3 * sh_coefficients(sh_degree)];
    for (k, value) in sh.iter_mut().enumerate().take(3 * sh_coefficients(view.sh_degree)) {
        let mut y = [0.0; GROUP];
        basis[k / 3].store(&mut y);
        *value = y[0] * v_rgb[k % 3];
    }
    sh
}
