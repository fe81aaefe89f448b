//! Spreads points evenly over the area of a mesh.

use cosurf_scene::Mesh;
use glam::Vec3;
use rayon::prelude::*;

/// Draws random points, on average one for each square with sides `spacing_m`. The same seed gives the
/// same points. Returns `None` if there would be more than `most` points.
pub(super) fn sample(mesh: &Mesh, spacing_m: f64, seed: u64, most: usize) -> Option<Vec<Vec3>> {
    let per_area = 1.0 / (spacing_m * spacing_m);
    let areas: Vec<f64> = mesh.areas().collect();
    // Written so that NaN and infinity count as too many.
    let affordable = areas.iter().sum::<f64>() * per_area < most as f64;
    if !affordable {
        return None;
    }
    let of_triangle = |(i, area): (usize, &f64)| {
        let mut random = Random::new(seed, i as u64);
        let corners = mesh.corners(i);
        // The number of points is rounded up or down at random, so that small triangles get points too.
        let count = (area * per_area + f64::from(random.unit())) as usize;
        (0..count).map(move |_| inside(corners, random.unit(), random.unit()))
    };
    Some(areas.par_iter().enumerate().flat_map_iter(of_triangle).collect())
}

/// A point in the triangle for two numbers in 0..1. Uniform random numbers give uniformly spread
/// points.
fn inside([a, b, c]: [Vec3; 3], u: f32, v: f32) -> Vec3 {
    let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
    a + (b - a) * u + (c - a) * v
}

/// Random numbers by SplitMix64 (Steele, Lea and Flood 2014), with one stream for each triangle.
struct Random(u64);

impl Random {
    fn new(seed: u64, stream: u64) -> Self {
        let mut random = Self(seed);
        Self(random.next() ^ stream.wrapping_mul(0xD1B5_4A32_D192_ED03))
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// The next random number, uniform in 0..1.
    fn unit(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u32 << 24) as f32
    }
}
