//! A reference renderer in f64, as short as possible: no tiles, no SIMD, forward only.
//!
//! Thresholds make the picture discontinuous: a splat is skipped, an alpha is clamped, a pixel is full. The gradients
//! of the engine ignore these jumps. So, for central differences, a picture with a changed parameter is rendered with
//! the [`Decisions`] of the unchanged picture.

use cosurf_scene::splats::sh_coefficients;
use cosurf_scene::{Camera, Splats};
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Channels of a pixel: red, green, blue, transmittance, normal (xyz), plane distance.
pub(super) type Pixel = [f64; 8];

/// For each pixel, the blended splats, nearest first, each with whether its alpha was clamped.
pub(super) type Decisions = Vec<Vec<(usize, bool)>>;

struct Seen {
    mean_px: DVec2,
    /// Inverse covariance on the screen (xx, xy, yy), 1/px².
    conic: [f64; 3],
    opacity: f64,
    value: [f64; 7],
    depth: f64,
}

/// Renders a picture. Also returns what was decided at thresholds.
pub(super) fn render(splats: &Splats, camera: &Camera, sh_degree: u32) -> (Vec<Pixel>, Decisions) {
    let seen: Vec<Seen> = (0..splats.len()).map(|i| see(splats, i, camera, sh_degree)).collect();
    let mut order: Vec<usize> = (0..seen.len()).filter(|i| seen[*i].depth > 0.2).collect();
    order.sort_by(|a, b| seen[*a].depth.total_cmp(&seen[*b].depth));
    pixels(camera)
        .map(|p| {
            let mut decisions = Vec::new();
            let mut transmittance = 1.0;
            for &i in &order {
                let alpha = alpha(&seen[i], p);
                if alpha < 1.0 / 255.0 {
                    continue;
                }
                let next = transmittance * (1.0 - alpha.min(0.99));
                if next < 1e-4 {
                    break;
                }
                decisions.push((i, alpha > 0.99));
                transmittance = next;
            }
            (blend(&seen, p, &decisions), decisions)
        })
        .unzip()
}

/// Renders a picture with the decisions of another picture.
pub(super) fn render_as_decided(
    splats: &Splats,
    camera: &Camera,
    sh_degree: u32,
    decisions: &Decisions,
) -> Vec<Pixel> {
    let seen: Vec<Seen> = (0..splats.len()).map(|i| see(splats, i, camera, sh_degree)).collect();
    pixels(camera).zip(decisions).map(|(p, decisions)| blend(&seen, p, decisions)).collect()
}

fn pixels(camera: &Camera) -> impl Iterator<Item = DVec2> {
    let [width, height] = camera.size_px;
    (0..height).flat_map(move |y| (0..width).map(move |x| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)))
}

fn alpha(splat: &Seen, p: DVec2) -> f64 {
    let d = splat.mean_px - p;
    let [a, b, c] = splat.conic;
    splat.opacity * (-0.5 * (a * d.x * d.x + 2.0 * b * d.x * d.y + c * d.y * d.y)).exp()
}

fn blend(seen: &[Seen], p: DVec2, decisions: &[(usize, bool)]) -> Pixel {
    let mut pixel = [0.0; 8];
    let mut transmittance = 1.0;
    for &(i, clamped) in decisions {
        let alpha = if clamped { 0.99 } else { alpha(&seen[i], p) };
        let weight = alpha * transmittance;
        let [r, g, b, nx, ny, nz, d] = seen[i].value;
        for (sum, value) in pixel.iter_mut().zip([r, g, b, 0.0, nx, ny, nz, d]) {
            *sum += weight * value;
        }
        transmittance *= 1.0 - alpha;
    }
    pixel[3] = transmittance;
    pixel
}

fn see(splats: &Splats, i: usize, camera: &Camera, sh_degree: u32) -> Seen {
    let mean = DVec3::from(splats.means[i].map(f64::from));
    let [w, x, y, z] = splats.quats[i].map(f64::from);
    let world_from_splat = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let cam_from_world = DMat3::from_quat(camera.cam_from_world.rotation);
    let t = camera.cam_from_world.transform(mean);
    let log_scale = DVec3::from(splats.log_scales[i].map(f64::from));
    let cam_from_splat = cam_from_world * world_from_splat;
    let covariance = {
        let axes = cam_from_splat * DMat3::from_diagonal(log_scale.exp());
        axes * axes.transpose()
    };
    let slope = |axis: usize| {
        let size = f64::from(camera.size_px[axis]);
        let limit = |edge: f64| (edge * size - camera.center_px[axis]) / camera.focal_px[axis];
        (t[axis] / t.z).clamp(limit(-0.15), limit(1.15))
    };
    let focal = camera.focal_px / t.z;
    let j = [DVec3::new(focal.x, 0.0, -focal.x * slope(0)), DVec3::new(0.0, focal.y, -focal.y * slope(1))];
    let (xx, xy, yy) =
        (j[0].dot(covariance * j[0]) + 0.3, j[0].dot(covariance * j[1]), j[1].dot(covariance * j[1]) + 0.3);
    let det = xx * yy - xy * xy;
    let shortest = (0..3).min_by(|a, b| log_scale[*a].total_cmp(&log_scale[*b])).expect("three axes");
    let axis = cam_from_splat.col(shortest);
    let normal = if axis.dot(t) < 0.0 { axis } else { -axis };
    let rgb = color(splats.sh_of(i), (mean - camera.cam_from_world.center()).normalize(), sh_degree);
    Seen {
        mean_px: camera.focal_px * t.truncate() / t.z + camera.center_px,
        conic: [yy / det, -xy / det, xx / det],
        opacity: 1.0 / (1.0 + (-f64::from(splats.opacity_logits[i])).exp()),
        value: [rgb[0], rgb[1], rgb[2], normal.x, normal.y, normal.z, -normal.dot(t)],
        depth: t.z,
    }
}

fn color(sh: &[f32], direction: DVec3, degree: u32) -> [f64; 3] {
    let DVec3 { x, y, z } = direction;
    let pi = std::f64::consts::PI;
    // From the definition of the real spherical harmonics, independent of the constants of the engine.
    let basis = [
        0.5 * (1.0 / pi).sqrt(),
        -(3.0 / (4.0 * pi)).sqrt() * y,
        (3.0 / (4.0 * pi)).sqrt() * z,
        -(3.0 / (4.0 * pi)).sqrt() * x,
        0.5 * (15.0 / pi).sqrt() * x * y,
        -0.5 * (15.0 / pi).sqrt() * y * z,
        0.25 * (5.0 / pi).sqrt() * (3.0 * z * z - 1.0),
        -0.5 * (15.0 / pi).sqrt() * x * z,
        0.25 * (15.0 / pi).sqrt() * (x * x - y * y),
        -0.25 * (35.0 / (2.0 * pi)).sqrt() * y * (3.0 * x * x - y * y),
        0.5 * (105.0 / pi).sqrt() * x * y * z,
        -0.25 * (21.0 / (2.0 * pi)).sqrt() * y * (5.0 * z * z - 1.0),
        0.25 * (7.0 / pi).sqrt() * z * (5.0 * z * z - 3.0),
        -0.25 * (21.0 / (2.0 * pi)).sqrt() * x * (5.0 * z * z - 1.0),
        0.25 * (105.0 / pi).sqrt() * z * (x * x - y * y),
        -0.25 * (35.0 / (2.0 * pi)).sqrt() * x * (x * x - 3.0 * y * y),
    ];
    let used = sh_coefficients(degree);
    [0, 1, 2].map(|c| (0.5 + (0..used).map(|k| basis[k] * f64::from(sh[3 * k + c])).sum::<f64>()).max(0.0))
}

/// For each splat: Σ (α T)², the number of pixels hit, and whether a pixel was hit while its transmittance was above
/// one half.
pub(super) fn scores(splats: &Splats, camera: &Camera, decisions: &Decisions) -> Vec<(f64, usize, bool)> {
    let seen: Vec<Seen> = (0..splats.len()).map(|i| see(splats, i, camera, 0)).collect();
    let mut scores = vec![(0.0, 0, false); splats.len()];
    for (p, decisions) in pixels(camera).zip(decisions) {
        let mut transmittance = 1.0;
        for &(i, clamped) in decisions {
            let alpha = if clamped { 0.99 } else { alpha(&seen[i], p) };
            scores[i].0 += (alpha * transmittance).powi(2);
            scores[i].1 += 1;
            scores[i].2 |= transmittance > 0.5;
            transmittance *= 1.0 - alpha;
        }
    }
    scores
}

/// For each splat and screen axis: the sum over pixels of |∂L/∂mean|, by central differences.
pub(super) fn absolute_gradients(
    splats: &Splats,
    camera: &Camera,
    sh_degree: u32,
    decisions: &Decisions,
    gradients: &[Pixel],
) -> Vec<DVec2> {
    let mut seen: Vec<Seen> = (0..splats.len()).map(|i| see(splats, i, camera, sh_degree)).collect();
    let step = 1e-5;
    let mut sums = vec![DVec2::ZERO; splats.len()];
    for ((p, decisions), gradient) in pixels(camera).zip(decisions).zip(gradients) {
        for &(i, _) in decisions {
            for axis in 0..2 {
                let mut at = |offset: f64| {
                    let mean_px = seen[i].mean_px;
                    seen[i].mean_px[axis] += offset;
                    let loss: f64 = blend(&seen, p, decisions).iter().zip(gradient).map(|(v, g)| v * g).sum();
                    seen[i].mean_px = mean_px;
                    loss
                };
                sums[i][axis] += (at(step) - at(-step)).abs() / (2.0 * step);
            }
        }
    }
    sums
}
