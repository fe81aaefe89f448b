//! Turns splats about the world's origin: positions, rotations and the spherical harmonics of their colours.
//!
//! What it knows nothing about: files, and which way is up.

use glam::{DQuat, DVec3};

use crate::Splats;
use crate::splats::sh_coefficients;

/// Lebedev's rule of 26 points integrates polynomials up to degree 7 over the sphere (V. I. Lebedev, "Quadratures on a
/// sphere", 1976). Shares of the sphere of each of the 6 corners of the octahedron, of the 12 middles of its edges and of the
/// 8 middles of its faces.
const SHARES: [f64; 3] = [1.0 / 21.0, 4.0 / 105.0, 9.0 / 280.0];

/// Turns splats by a rotation of unit length.
pub fn turn(splats: &mut Splats, rotation: DQuat) {
    for mean in &mut splats.means {
        *mean = (rotation * DVec3::from_array(mean.map(f64::from))).as_vec3().to_array();
    }
    for quat in &mut splats.quats {
        let [w, x, y, z] = quat.map(f64::from);
        let [x, y, z, w] = (rotation * DQuat::from_xyzw(x, y, z, w)).to_array();
        *quat = [w, x, y, z].map(|value| value as f32);
    }
    turn_harmonics(splats, rotation);
}

fn turn_harmonics(splats: &mut Splats, rotation: DQuat) {
    let count = sh_coefficients(splats.sh_degree);
    let new_of_old = harmonics_of(rotation);
    let stride = splats.sh_stride();
    let mut old = vec![0.0; stride];
    for sh in splats.sh.chunks_exact_mut(stride) {
        old.copy_from_slice(sh);
        for (new, row) in new_of_old.iter().enumerate().take(count).skip(1) {
            for channel in 0..3 {
                let of = |k: usize| row[k] * f64::from(old[3 * k + channel]);
                sh[3 * new + channel] = (1..count).map(of).sum::<f64>() as f32;
            }
        }
    }
}

/// How much of each old harmonic is in each new one: the integral of their product over the sphere.
fn harmonics_of(rotation: DQuat) -> [[f64; 16]; 16] {
    let mut new_of_old = [[0.0; 16]; 16];
    let back = rotation.inverse();
    for (direction, share) in sphere() {
        let (new, old) = (basis(direction), basis(back * direction));
        for (row, new) in new_of_old.iter_mut().zip(new) {
            row.iter_mut().zip(old).for_each(|(sum, old)| *sum += share * new * old);
        }
    }
    new_of_old
}

/// The points of the rule, each with its share of the whole sphere's area of 4 π.
fn sphere() -> impl Iterator<Item = (DVec3, f64)> {
    let signs = [-1.0, 0.0, 1.0];
    let points = signs.into_iter().flat_map(move |x| {
        signs.into_iter().flat_map(move |y| signs.into_iter().map(move |z| DVec3::new(x, y, z)))
    });
    points.filter(|point| *point != DVec3::ZERO).map(|point| {
        let kind = point.length_squared() as usize - 1;
        (point.normalize(), 4.0 * std::f64::consts::PI * SHARES[kind])
    })
}

/// The real spherical harmonics up to degree 3, in the order and with the signs of 3DGS (`utils/sh_utils.py` of
/// graphdeco-inria/gaussian-splatting).
fn basis(DVec3 { x, y, z }: DVec3) -> [f64; 16] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let of = |square: f64| (square / std::f64::consts::PI).sqrt();
    [
        0.5 * of(1.0),
        -0.5 * of(3.0) * y,
        0.5 * of(3.0) * z,
        -0.5 * of(3.0) * x,
        0.5 * of(15.0) * x * y,
        -0.5 * of(15.0) * y * z,
        0.25 * of(5.0) * (2.0 * zz - xx - yy),
        -0.5 * of(15.0) * x * z,
        0.25 * of(15.0) * (xx - yy),
        -0.125 * of(70.0) * y * (3.0 * xx - yy),
        0.5 * of(105.0) * x * y * z,
        -0.125 * of(42.0) * y * (4.0 * zz - xx - yy),
        0.25 * of(7.0) * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.125 * of(42.0) * x * (4.0 * zz - xx - yy),
        0.25 * of(105.0) * z * (xx - yy),
        -0.125 * of(70.0) * x * (xx - 3.0 * yy),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn splat(sh_degree: u32) -> Splats {
        let mut splats = Splats::with_capacity(1, sh_degree);
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|k| (k as f32 * 0.7).sin()).collect();
        splats.push([1.0, 2.0, 3.0], [0.9, 0.1, -0.3, 0.2], [-1.0, -2.0, -3.0], 0.5, &sh);
        splats
    }

    fn color(splats: &Splats, direction: DVec3) -> Vec<f64> {
        let of = |channel: usize| {
            splats
                .sh_of(0)
                .chunks_exact(3)
                .zip(basis(direction))
                .map(|(sh, b)| f64::from(sh[channel]) * b)
                .sum()
        };
        (0..3).map(of).collect()
    }

    #[test]
    fn what_was_seen_from_a_side_is_seen_from_the_turned_side() {
        let rotation = DQuat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize();
        for degree in 0..=3 {
            let (old, mut new) = (splat(degree), splat(degree));
            turn(&mut new, rotation);
            for direction in [DVec3::X, DVec3::new(1.0, -2.0, 0.5), DVec3::new(-0.2, 0.3, -0.9)] {
                let direction = direction.normalize();
                let seen = color(&new, rotation * direction).into_iter().zip(color(&old, direction));
                seen.for_each(|(a, b)| assert!((a - b).abs() < 1e-6, "degree {degree}: {a} {b}"));
            }
            let axis = |splats: &Splats| {
                let [w, x, y, z] = splats.quats[0].map(f64::from);
                DQuat::from_xyzw(x, y, z, w).normalize() * DVec3::X
            };
            assert!((axis(&new) - rotation * axis(&old)).length() < 1e-6);
            turn(&mut new, rotation.inverse());
            let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
            assert!(near(&new.means[0], &old.means[0]) && near(&new.sh, &old.sh));
        }
    }
}
