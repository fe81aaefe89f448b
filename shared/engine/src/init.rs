//! Initial splats: one for each point of the sparse cloud.

use cosurf_scene::splats::{SH_C0, sh_coefficients};
use cosurf_scene::{SparsePoint, Splats};
use glam::{DQuat, DVec3};

use crate::nearest::{Near, Tree};
use crate::plane::normal_of;

/// Opacity of a new splat. 3DGS starts with 0.1, but short runs end before it has risen far enough.
const OPACITY: f32 = 0.3;

/// Number of nearest other points; the RMS distance to them is the initial scale (3DGS).
const NEIGHBOURS: usize = 3;
/// Number of nearest points, including the point itself, whose plane gives the initial normal.
const PLANE_POINTS: usize = 10;
/// Thickness of a flat splat, as a share of its width.
const THICKNESS: f64 = 0.2;

/// Shape of the initial splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Balls, as in 3DGS.
    Round,
    /// Discs in the plane of the nearest points, for training surfaces. Where these points have no plane, a splat is a
    /// ball.
    Flat,
}

/// Creates a splat at each point, with the colour of the point. The splat is as wide as the RMS distance to the three
/// nearest other points. Widths are clamped to the range from `extent` × 1e-6 to `extent` × 0.5, so that duplicates and
/// far outliers can still be trained. If there are more than `capacity` points, `capacity` of them are used, evenly
/// spaced in the list.
pub fn splats_from_points(
    points: &[SparsePoint],
    extent: f64,
    capacity: usize,
    sh_degree: u32,
    form: Form,
) -> Splats {
    let chosen: Vec<&SparsePoint> = if points.len() <= capacity {
        points.iter().collect()
    } else {
        (0..capacity).map(|i| &points[i * points.len() / capacity]).collect()
    };
    let mut splats = Splats::with_capacity(chosen.len(), sh_degree);
    let positions: Vec<[f64; 3]> = chosen.iter().map(|point| point.position.to_array()).collect();
    let tree = Tree::new(&positions, 1);
    let mut sh = vec![0.0; 3 * sh_coefficients(sh_degree)];
    let logit = libm::logf(OPACITY / (1.0 - OPACITY));
    for (point, position) in chosen.iter().zip(&positions) {
        for (value, byte) in sh.iter_mut().zip(point.rgb) {
            *value = (f32::from(byte) / 255.0 - 0.5) / SH_C0;
        }
        let near = tree.nearest::<PLANE_POINTS>(*position);
        let width = width(&near).clamp(extent * 1e-6, extent * 0.5).max(f64::from(f32::MIN_POSITIVE));
        let normal = (form == Form::Flat).then(|| normal(&near, &positions)).flatten();
        let (quat, thickness) = normal.map_or((DQuat::IDENTITY, width), |normal| {
            (DQuat::from_rotation_arc(DVec3::Z, normal), THICKNESS * width)
        });
        let log_scale = [width, width, thickness].map(|scale| libm::log(scale) as f32);
        let quat = [quat.w, quat.x, quat.y, quat.z].map(|v| v as f32);
        splats.push(position.map(|v| v as f32), quat, log_scale, logit, &sh);
    }
    splats
}

/// RMS distance to the nearest other points; infinite if there are none. The first of `near` is the point itself.
fn width(near: &[Near<f64>]) -> f64 {
    let others = near[1..=NEIGHBOURS].iter().map(|near| near.distance_squared).filter(|d| d.is_finite());
    let count = others.clone().count();
    if count == 0 { f64::INFINITY } else { (others.sum::<f64>() / count as f64).sqrt() }
}

/// Normal of the plane that fits the points of `near`, if they have a plane.
fn normal(near: &[Near<f64>], positions: &[[f64; 3]]) -> Option<DVec3> {
    let found = near.iter().filter(|near| near.distance_squared.is_finite());
    normal_of(&found.map(|near| DVec3::from(positions[near.index as usize])).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn cloud(positions: impl IntoIterator<Item = DVec3>) -> Vec<SparsePoint> {
        let point = |position| SparsePoint { position, rgb: [128; 3], views: Vec::new() };
        positions.into_iter().map(point).collect()
    }

    #[test]
    fn discs_lie_in_the_plane_of_their_points() {
        let axis = DVec3::new(1.0, -2.0, 3.0).normalize();
        let (u, v) = axis.any_orthonormal_pair();
        let grid = (0..64).map(|i| f64::from(i % 8) * u + f64::from(i / 8) * v);
        let points = cloud(grid);
        let flat = splats_from_points(&points, 10.0, 64, 0, Form::Flat);
        let round = splats_from_points(&points, 10.0, 64, 0, Form::Round);
        for i in 0..64 {
            let [w, x, y, z] = flat.quats[i].map(f64::from);
            let normal = DQuat::from_xyzw(x, y, z, w) * DVec3::Z;
            assert!(normal.dot(axis).abs() > 1.0 - 1e-6, "{normal} is not along {axis}");
            let [a, b, c] = flat.log_scales[i];
            assert_eq!([a, b], [round.log_scales[i][0]; 2]);
            assert!((c - a - (THICKNESS as f32).ln()).abs() < 1e-5);
        }
    }

    #[test]
    fn points_without_a_plane_become_balls() {
        for points in [cloud([DVec3::ZERO]), cloud((0..20).map(|i| f64::from(i) * DVec3::ONE)), cloud([])] {
            let flat = splats_from_points(&points, 10.0, 64, 0, Form::Flat);
            assert_eq!(flat, splats_from_points(&points, 10.0, 64, 0, Form::Round));
        }
    }
}
