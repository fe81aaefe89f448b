//! The plane that fits a set of points best.

use glam::{DMat3, DVec3};

/// Points have a plane if an estimate of `(λ₁ - λ₃)(λ₂ - λ₃)` exceeds this. λ₁ ≥ λ₂ ≥ λ₃ are the eigenvalues of the
/// covariance of the points, scaled to sum 1. On a line λ₂ and λ₃ are equal, and in a ball all three are. The estimate
/// is the product divided by a number from 1 to √3.
const LINE_MAX: f64 = 1e-3;

/// The unit direction in which the points spread least. `None` if there are no points, or if they nearly lie on a line,
/// coincide, spread almost equally in every direction, or contain NaN.
pub(crate) fn normal_of(points: &[DVec3]) -> Option<DVec3> {
    let mean = points.iter().sum::<DVec3>() / points.len() as f64;
    let spread = points
        .iter()
        .map(|point| *point - mean)
        .fold(DMat3::ZERO, |sum, d| sum + DMat3::from_cols(d * d.x, d * d.y, d * d.z));
    let size = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
    let without = spread * (1.0 / size) - DMat3::IDENTITY * least_eigenvalue(&(spread * (1.0 / size)))?;
    // After subtracting the smallest eigenvalue, the matrix has rank two: its rows span the plane.
    let rows = [without.x_axis, without.y_axis, without.z_axis];
    let normals = [rows[0].cross(rows[1]), rows[1].cross(rows[2]), rows[2].cross(rows[0])];
    let longest = normals.into_iter().max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))?;
    // A comparison with NaN is false, so points with NaN have no plane.
    (longest.length() > LINE_MAX).then(|| longest.normalize())
}

/// The smallest eigenvalue of a symmetric matrix in closed form (Smith, "Eigenvalues of a symmetric 3 × 3 matrix",
/// 1961); `None` if all three are almost equal, or if the matrix contains NaN.
fn least_eigenvalue(a: &DMat3) -> Option<f64> {
    let third = (a.x_axis.x + a.y_axis.y + a.z_axis.z) / 3.0;
    let rest = *a - DMat3::IDENTITY * third;
    let squares: f64 = rest.to_cols_array().iter().map(|v| v * v).sum();
    let radius = (squares / 6.0).sqrt();
    let half = (rest * (1.0 / radius)).determinant() / 2.0;
    let angle = libm::acos(half.clamp(-1.0, 1.0)) / 3.0;
    let least = third + 2.0 * radius * libm::cos(angle + 2.0 * std::f64::consts::FRAC_PI_3);
    (radius > 1e-9).then_some(least)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::random::{Purpose, Random};

    #[test]
    fn finds_a_noisy_plane_and_no_plane_in_lines_or_balls() {
        let mut random = Random::new(3, Purpose::Test, 0, 0);
        let mut normal = || f64::from(random.normal());
        for _ in 0..100 {
            let axis = DVec3::new(normal(), normal(), normal()).normalize();
            let (u, v) = axis.any_orthonormal_pair();
            let far = 1e4 * DVec3::new(normal(), normal(), normal());
            let points: Vec<DVec3> = (0..20)
                .map(|_| far + 3.0 * normal() * u + 2.0 * normal() * v + 0.01 * normal() * axis)
                .collect();
            let found = normal_of(&points).unwrap();
            assert!((found.length() - 1.0).abs() < 1e-12);
            assert!(found.dot(axis).abs() > 0.999, "{found} is not along {axis}");
            let line: Vec<DVec3> = (0..20).map(|_| far + normal() * u).collect();
            assert_eq!(normal_of(&line), None);
        }
        let corners = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];
        assert_eq!(normal_of(&corners), None);
        assert_eq!(normal_of(&[DVec3::ONE; 4]), None);
        assert_eq!(normal_of(&[]), None);
    }
}
