//! Applies similarity transforms (rotation, scale, translation) to points, cameras and splats, and finds them from
//! pairs of points.

use cosurf_link::Model;
use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Camera, LocalFrame, Pose, Splats};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// A similarity transform: the point `p` moves to `scale · rotation p + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Similarity {
    /// Scale factor, positive.
    pub scale: f64,
    /// Rotation, a unit quaternion.
    pub rotation: DQuat,
    /// Translation, world units.
    pub translation: DVec3,
}

impl Similarity {
    /// The similarity that moves nothing.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Moves a point.
    pub fn apply(&self, p: DVec3) -> DVec3 {
        self.scale * (self.rotation * p) + self.translation
    }

    /// The similarity that moves everything back.
    pub fn inverse(&self) -> Self {
        let (scale, rotation) = (1.0 / self.scale, self.rotation.inverse());
        Self { scale, rotation, translation: -scale * (rotation * self.translation) }
    }

    /// The similarity that first moves by `first`, then by `self`.
    pub fn after(&self, first: &Self) -> Self {
        Self {
            scale: self.scale * first.scale,
            rotation: (self.rotation * first.rotation).normalize(),
            translation: self.apply(first.translation),
        }
    }

    /// Converts a similarity of points in `frame` to one of world points.
    pub(crate) fn world_from_frame(&self, frame: &LocalFrame) -> Self {
        if *frame == LocalFrame::WORLD {
            return *self;
        }
        let origin = frame.origin();
        let turned = self.scale * (self.rotation * origin);
        Self { translation: origin - turned + frame.unit() * self.translation, ..*self }
    }

    /// Converts a similarity of world points to one of points in `frame`.
    pub(crate) fn frame_from_world(&self, frame: &LocalFrame) -> Self {
        if *frame == LocalFrame::WORLD {
            return *self;
        }
        let origin = frame.origin();
        let turned = self.scale * (self.rotation * origin);
        Self { translation: (self.translation - origin + turned) / frame.unit(), ..*self }
    }

    /// Moves a camera along with a model. The moved camera gives the same picture of the moved model, with depths
    /// multiplied by the scale.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let Pose { rotation, translation } = camera.cam_from_world;
        let rotation = (rotation * self.rotation.inverse()).normalize();
        let translation = self.scale * translation - rotation * self.translation;
        Camera { cam_from_world: Pose { rotation, translation }, ..*camera }
    }

    /// Moves a whole model.
    pub fn model(&self, model: &Model) -> Model {
        let cameras = model.cameras.iter().map(|camera| self.camera(camera)).collect();
        Model { splats: self.splats(&model.splats), cameras }
    }

    fn splats(&self, splats: &Splats) -> Splats {
        let turns = [1, 2, 3].map(|degree| Turn::new(degree, self.rotation));
        let log_scale = libm::log(self.scale) as f32;
        let mut moved = splats.clone();
        for i in 0..moved.len() {
            let mean = DVec3::from_array(moved.means[i].map(f64::from));
            moved.means[i] = self.apply(mean).to_array().map(|value| value as f32);
            let [w, x, y, z] = moved.quats[i].map(f64::from);
            let q = self.rotation * DQuat::from_xyzw(x, y, z, w);
            moved.quats[i] = [q.w, q.x, q.y, q.z].map(|value| value as f32);
            moved.log_scales[i].iter_mut().for_each(|value| *value += log_scale);
        }
        let stride = moved.sh_stride();
        for sh in moved.sh.chunks_exact_mut(stride) {
            turns.iter().take(splats.sh_degree as usize).for_each(|turn| turn.apply(sh));
        }
        moved
    }

    /// The similarity that moves the points `from` closest to the points `to` (Horn, "Closed-form solution of absolute
    /// orientation using unit quaternions"). `None` for fewer than 3 pairs, for different numbers of points, or if all
    /// points of one side are the same.
    pub fn between(from: &[DVec3], to: &[DVec3]) -> Option<Self> {
        if from.len() < 3 || from.len() != to.len() {
            return None;
        }
        let mean = |points: &[DVec3]| points.iter().sum::<DVec3>() / points.len() as f64;
        let (from_mean, to_mean) = (mean(from), mean(to));
        let (mut s, mut from_spread, mut to_spread) = ([[0.0; 3]; 3], 0.0, 0.0);
        for (a, b) in from.iter().zip(to) {
            let (a, b) = (*a - from_mean, *b - to_mean);
            from_spread += a.length_squared();
            to_spread += b.length_squared();
            for (row, value) in s.iter_mut().zip(a.to_array()) {
                row.iter_mut().zip(b.to_array()).for_each(|(sum, other)| *sum += value * other);
            }
        }
        let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = s;
        let [w, x, y, z] = strongest_axis([
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]);
        let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
        let scale = (to_spread / from_spread).sqrt();
        let found = Self { scale, rotation, translation: to_mean - scale * (rotation * from_mean) };
        (scale.is_finite() && scale > 0.0 && rotation.is_finite()).then_some(found)
    }
}

/// The eigenvector for the largest eigenvalue of a symmetric matrix, by Jacobi rotations.
fn strongest_axis(mut a: [[f64; 4]; 4]) -> [f64; 4] {
    /// Number of sweeps over the matrix; far more than convergence takes.
    const SWEEPS: usize = 24;
    let mut v = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    for _ in 0..SWEEPS {
        for p in 0..3 {
            for q in p + 1..4 {
                if a[p][q] == 0.0 {
                    continue;
                }
                let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                let t = theta.signum() / (theta.abs() + libm::hypot(theta, 1.0));
                let t = if theta == 0.0 { 1.0 } else { t };
                let c = 1.0 / libm::hypot(t, 1.0);
                let s = t * c;
                for k in 0..4 {
                    (a[k][p], a[k][q]) = (c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]);
                }
                for k in 0..4 {
                    (a[p][k], a[q][k]) = (c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]);
                    (v[k][p], v[k][q]) = (c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]);
                }
            }
        }
    }
    let strongest = (0..4).fold(0, |best, i| if a[i][i] > a[best][best] { i } else { best });
    v.map(|row| row[strongest])
}

/// Rotates the spherical harmonics of one degree. In each rotated direction, the rotated function must have the value
/// of the original function in the direction before rotation. As many directions as there are coefficients determine
/// the matrix.
struct Turn {
    degree: usize,
    /// Rows of a square matrix with `2 degree + 1` rows.
    matrix: Vec<Vec<f64>>,
}

impl Turn {
    fn new(degree: usize, rotation: DQuat) -> Self {
        let count = 2 * degree + 1;
        let directions: Vec<DVec3> = (0..count).map(|i| direction(i, count)).collect();
        let rows = |turn: DQuat| directions.iter().map(|d| band(degree, turn * *d)).collect();
        Self { degree, matrix: solve(rows(rotation), rows(DQuat::IDENTITY)) }
    }

    /// Rotates the coefficients of this degree in `sh`, the coefficients of one splat `[(highest degree + 1)², rgb]`.
    fn apply(&self, sh: &mut [f32]) {
        let first = 3 * self.degree * self.degree;
        let before: Vec<f32> = sh[first..first + 3 * self.matrix.len()].to_vec();
        for (m, row) in self.matrix.iter().enumerate() {
            for channel in 0..3 {
                let terms = row.iter().enumerate();
                let sum: f64 = terms.map(|(k, value)| value * f64::from(before[3 * k + channel])).sum();
                sh[first + 3 * m + channel] = sum as f32;
            }
        }
    }
}

/// Direction `i` of `count` on the upper half of the sphere. These directions are far from each other and from the
/// opposites of each other.
fn direction(i: usize, count: usize) -> DVec3 {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let z = (i as f64 + 0.5) / count as f64;
    let (sin, cos) = libm::sincos(golden * i as f64);
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * cos, r * sin, z)
}

/// The basis functions of a degree (1, 2 or 3) in direction `d`, in the order and with the signs of 3DGS.
fn band(degree: usize, d: DVec3) -> Vec<f64> {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    // Each factor is `SH_C0` times the square root of a rational number.
    let c = |square: f64| square.sqrt() * f64::from(SH_C0);
    match degree {
        1 => vec![-c(3.0) * y, c(3.0) * z, -c(3.0) * x],
        2 => vec![
            c(15.0) * x * y,
            -c(15.0) * y * z,
            c(1.25) * (2.0 * zz - xx - yy),
            -c(15.0) * x * z,
            c(3.75) * (xx - yy),
        ],
        _ => vec![
            -c(4.375) * y * (3.0 * xx - yy),
            c(105.0) * x * y * z,
            -c(2.625) * y * (4.0 * zz - xx - yy),
            c(1.75) * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -c(2.625) * x * (4.0 * zz - xx - yy),
            c(26.25) * z * (xx - yy),
            -c(4.375) * x * (xx - 3.0 * yy),
        ],
    }
}

/// Computes `a⁻¹ b` by Gauss-Jordan elimination; `a` must not be singular.
pub(super) fn solve(mut a: Vec<Vec<f64>>, mut b: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let n = a.len();
    for column in 0..n {
        let largest = (column..n).max_by(|i, j| a[*i][column].abs().total_cmp(&a[*j][column].abs()));
        let pivot = largest.unwrap_or(column);
        a.swap(column, pivot);
        b.swap(column, pivot);
        let (a_row, b_row, value) = (a[column].clone(), b[column].clone(), a[column][column]);
        for row in (0..n).filter(|row| *row != column) {
            let share = a[row][column] / value;
            a[row].iter_mut().zip(&a_row).for_each(|(to, from)| *to -= share * from);
            b[row].iter_mut().zip(&b_row).for_each(|(to, from)| *to -= share * from);
        }
    }
    for (row, values) in b.iter_mut().enumerate() {
        values.iter_mut().for_each(|value| *value /= a[row][row]);
    }
    b
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_engine::Renderer;

    use super::*;
    use crate::testing::{above, ground};

    /// The frame of a wrong model in the tests: rotated by 5°, scaled by 1.1, moved by 2 m.
    pub(crate) fn wrong() -> Similarity {
        let rotation = DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 5f64.to_radians());
        Similarity { scale: 1.1, rotation, translation: DVec3::new(1.2, -1.6, 0.0) }
    }

    /// Ground with view-dependent colours: spherical harmonics up to degree 3.
    fn shimmering() -> Splats {
        let plain = ground(-4.0, 4.0);
        let mut splats = Splats::with_capacity(plain.len(), 3);
        for i in 0..plain.len() {
            let sh: Vec<f32> = (0..48)
                .map(|k| if k < 3 { plain.sh_of(i)[k] } else { 0.2 * ((i * 7 + k * 13) as f32).sin() })
                .collect();
            splats.push(plain.means[i], plain.quats[i], plain.log_scales[i], plain.opacity_logits[i], &sh);
        }
        splats
    }

    #[test]
    fn a_moved_model_looks_the_same_to_moved_cameras() {
        let model = Model { splats: shimmering(), cameras: vec![above(-1.0), above(1.5)] };
        for moved in [wrong(), Similarity { scale: 0.4, ..wrong() }] {
            let there = moved.model(&model);
            let (mut before, mut after) = (Renderer::new(&model.splats, 1), Renderer::new(&there.splats, 1));
            for (camera, moved_camera) in model.cameras.iter().zip(&there.cameras) {
                let (a, b) = (before.render(camera), after.render(moved_camera));
                let off = a.rgb.iter().zip(&b.rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(off < 2e-3, "colours are off by {off}");
                let middle = a.depth.len() / 2 + 24;
                let ratio = f64::from(b.depth[middle] / a.depth[middle]);
                assert!((ratio - moved.scale).abs() < 1e-3, "depths are scaled by {ratio}");
            }
            let unturned = Splats { sh: model.splats.sh.clone(), ..there.splats.clone() };
            let (a, b) = (before.render(&above(1.5)), Renderer::new(&unturned, 1).render(&there.cameras[1]));
            let off = a.rgb.iter().zip(&b.rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(off > 1e-2, "the comparison notices harmonics that were not rotated: {off}");
        }
    }

    #[test]
    fn the_similarity_between_points_is_found_and_none_fits_a_mirror_image() {
        let from: Vec<DVec3> = (0..9).map(|i| direction(i, 9) * (1.0 + i as f64)).collect();
        let to: Vec<DVec3> = from.iter().map(|p| wrong().apply(*p)).collect();
        let found = Similarity::between(&from, &to).unwrap();
        assert!(from.iter().zip(&to).all(|(a, b)| found.apply(*a).distance(*b) < 1e-9), "{found:?}");
        let mirrored: Vec<DVec3> = from.iter().map(|p| DVec3::new(-p.x, p.y, p.z)).collect();
        let found = Similarity::between(&from, &mirrored).unwrap();
        assert!(from.iter().zip(&mirrored).any(|(a, b)| found.apply(*a).distance(*b) > 1.0));
        assert_eq!(Similarity::between(&from[..2], &to[..2]), None);
        assert_eq!(Similarity::between(&[DVec3::ONE; 3], &[DVec3::ONE; 3]), None);
    }

    #[test]
    fn similarities_are_inverted_and_chained() {
        let point = DVec3::new(3.0, -2.0, 5.0);
        let other = Similarity { scale: 0.4, translation: DVec3::X, ..wrong() };
        assert!(wrong().inverse().apply(wrong().apply(point)).distance(point) < 1e-12);
        assert!(other.after(&wrong()).apply(point).distance(other.apply(wrong().apply(point))) < 1e-12);
    }
}
