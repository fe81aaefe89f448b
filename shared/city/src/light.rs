//! Lighting: a sun that casts shadows, a sky that surroundings hide in part, and its reflections.

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::appearance::Appearance;
use super::mesh::Triangle;
use cosurf_scene::bvh::{Bvh, Ray};

/// Irradiance of the sun, linear. A white horizontal surface in the sun is slightly below white in the picture.
const SUN: Vec3 = Vec3::new(1.42, 1.30, 1.10);
/// Irradiance of the sky on horizontal ground, linear.
const SKY: Vec3 = Vec3::new(0.27, 0.33, 0.42);
/// Light that the ground reflects onto surfaces that face down.
const BOUNCE: Vec3 = Vec3::new(0.20, 0.175, 0.14);
/// Cell size of the height maps, metres.
const CELL_M: f32 = 1.5;
/// Radii over which heights are averaged to estimate how much of the sky is hidden, metres.
const RADII_M: [f32; 2] = [2.6, 8.0];
/// Rays to the sun form one bundle if their origins are no farther apart than this, metres.
const BUNDLE_M: f32 = 1.0;
/// Distance from the surface at which rays start, metres.
const LIFT_M: f32 = 0.012;

/// A surface point to be lit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lit {
    pub(super) position: Vec3,
    /// Unit, on the viewer's side.
    pub(super) normal: Vec3,
    /// Unit, from the surface to the viewer.
    pub(super) to_viewer: Vec3,
}

/// The city's light.
#[derive(Debug)]
pub(super) struct Light {
    /// Unit, towards the sun.
    sun: Vec3,
    heights: [HeightMap; 2],
}

/// Heights of the topmost surface, averaged.
#[derive(Debug)]
struct HeightMap {
    origin: Vec2,
    side: usize,
    values: Vec<f32>,
}

impl Light {
    /// Measures the heights of the topmost surface within `half_side_m` of the centre, by rays from above.
    pub(super) fn new(bvh: &Bvh, triangles: &[Triangle], half_side_m: f32, sun: Vec3) -> Self {
        let highest = triangles.iter().flat_map(|t| t.corners).map(|p| p.z).fold(0.0, f32::max) + 1.0;
        let side = (2.0 * half_side_m / CELL_M) as usize + 2;
        let origin = Vec2::splat(-half_side_m);
        let tops: Vec<f32> = (0..side * side)
            .into_par_iter()
            .map(|i| {
                let p = origin + Vec2::new((i % side) as f32, (i / side) as f32) * CELL_M;
                let ray = Ray {
                    origin: p.extend(highest),
                    direction: Vec3::NEG_Z,
                    t_min: 0.0,
                    t_max: f32::INFINITY,
                };
                bvh.nearest(&[ray])[0].map_or(0.0, |hit| highest - hit.t)
            })
            .collect();
        let heights = RADII_M.map(|radius_m| {
            let reach = (0.5 * radius_m / CELL_M + 0.5) as usize;
            // Two box filters make a tent filter.
            let values = (0..2).fold(tops.clone(), |values, _| box_blurred(&values, side, reach));
            HeightMap { origin, side, values }
        });
        Self { sun: sun.normalize(), heights }
    }

    /// The linear colour that the viewer sees; `sunny` tells whether the sun shines on the point.
    pub(super) fn radiance(&self, lit: &Lit, appearance: &Appearance, sunny: bool) -> Vec3 {
        let facing = lit.normal.dot(self.sun);
        let front = facing.max(0.0);
        let through = appearance.translucent * (0.35 * (1.0 - front) + (-facing).max(0.0));
        let sun = if sunny { front + through } else { 0.0 };
        let open = self.openness(lit.position, lit.normal);
        let upward = 0.5 + 0.5 * lit.normal.z;
        let ambient = SKY * (upward * open) + BOUNCE * ((1.0 - upward) * (0.4 + 0.6 * open));
        let diffuse = appearance.albedo * (SUN * sun + ambient);
        if appearance.mirror <= 0.0 {
            return diffuse;
        }
        let cosine = lit.normal.dot(lit.to_viewer).clamp(0.0, 1.0);
        let grazing = power(1.0 - cosine, 5);
        let part =
            appearance.mirror + (1.0 - appearance.mirror) * grazing * (appearance.mirror * 8.0).min(1.0);
        let mirrored = lit.normal * (2.0 * cosine) - lit.to_viewer;
        let glint = if sun > 0.0 { 5.0 * power(mirrored.dot(self.sun).max(0.0), 48) } else { 0.0 };
        diffuse * (1.0 - part) + (sky(mirrored) * (0.35 + 0.65 * open) + SUN * glint) * part
    }

    /// Whether the sun would light a surface if nothing shaded it.
    pub(super) fn reaches(&self, lit: &Lit, appearance: &Appearance) -> bool {
        lit.normal.dot(self.sun) > 0.0 || appearance.translucent > 0.0
    }

    /// Whether the sun shines on each of several points; false for `None`. Faster if they are close together.
    pub(super) fn sunny<const N: usize>(&self, bvh: &Bvh, places: &[Option<Lit>; N]) -> [bool; N] {
        let Some(any) = places.iter().flatten().next() else { return [false; N] };
        let rays = places.each_ref().map(|place| {
            // A missing point repeats another point's ray, which costs next to nothing in a bundle.
            let lit = place.as_ref().unwrap_or(any);
            let side = if lit.normal.dot(self.sun) >= 0.0 { LIFT_M } else { -LIFT_M };
            Ray {
                origin: lit.position + lit.normal * side,
                direction: self.sun,
                t_min: 1e-3,
                t_max: f32::INFINITY,
            }
        });
        let bounds = (Vec3::MAX, Vec3::MIN);
        let (low, high) =
            rays.iter().fold(bounds, |(low, high), ray| (low.min(ray.origin), high.max(ray.origin)));
        if (high - low).max_element() < BUNDLE_M {
            let blocked = bvh.blocked(&rays);
            return std::array::from_fn(|i| places[i].is_some() && !blocked[i]);
        }
        std::array::from_fn(|i| places[i].is_some() && !bvh.blocked(&[rays[i]])[0])
    }

    /// Fraction of the sky that the surroundings leave visible, 0 to 1.
    fn openness(&self, p: Vec3, normal: Vec3) -> f32 {
        let mut open = 1.0;
        for (map, radius_m) in self.heights.iter().zip(RADII_M) {
            let q = p + normal * (0.3 * radius_m);
            let hidden = ((map.at(q.truncate()) - q.z) / radius_m).clamp(0.0, 1.3);
            open /= 1.0 + 0.9 * hidden;
        }
        open
    }
}

impl HeightMap {
    fn at(&self, p: Vec2) -> f32 {
        let most = (self.side - 2) as f32;
        let q = ((p - self.origin) * (1.0 / CELL_M)).clamp(Vec2::ZERO, Vec2::splat(most + 0.999));
        let (x, y) = (q.x as usize, q.y as usize);
        let (fx, fy) = (q.x - x as f32, q.y - y as f32);
        let row = |y: usize| {
            let i = y * self.side + x;
            self.values[i] + (self.values[i + 1] - self.values[i]) * fx
        };
        let low = row(y);
        low + (row(y + 1) - low) * fy
    }
}

/// Averages over squares of `2 reach + 1` cells; border values are repeated outwards.
fn box_blurred(values: &[f32], side: usize, reach: usize) -> Vec<f32> {
    let window = |line: &dyn Fn(usize) -> f32, i: usize| {
        let sum: f32 = (0..=2 * reach).map(|k| line((i + k).saturating_sub(reach).min(side - 1))).sum();
        sum / (2 * reach + 1) as f32
    };
    let rows: Vec<f32> = (0..side * side)
        .into_par_iter()
        .map(|i| window(&|x| values[i / side * side + x], i % side))
        .collect();
    (0..side * side).into_par_iter().map(|i| window(&|y| rows[y * side + i % side], i / side)).collect()
}

/// Colour of the sky in a direction; the ground's mean colour for directions that point down.
fn sky(direction: Vec3) -> Vec3 {
    if direction.z < 0.0 {
        return Vec3::new(0.16, 0.16, 0.13);
    }
    let high = 1.0 - power(1.0 - direction.z, 3);
    Vec3::new(0.78, 0.84, 0.92).lerp(Vec3::new(0.24, 0.40, 0.74), high)
}

/// An integer power by multiplications only.
fn power(base: f32, exponent: u32) -> f32 {
    let (mut result, mut square, mut left) = (1.0, base, exponent);
    while left > 0 {
        if left & 1 == 1 {
            result *= square;
        }
        square *= square;
        left >>= 1;
    }
    result
}

/// Linear to 8-bit sRGB, within 1.5 steps of the standard's curve. Uses square roots only, as powers
/// differ between platforms' libraries.
pub(super) fn encode(linear: Vec3) -> [u8; 3] {
    linear.to_array().map(|x| {
        // A soft shoulder preserves texture on the brightest walls.
        let x = (x * 1.12 / (1.0 + 0.12 * x)).clamp(0.0, 1.0);
        let (a, b) = (x.sqrt(), x.sqrt().sqrt());
        let y = 0.662_002_7 * a + 0.684_122 * b - 0.323_583_6 * b.sqrt() - 0.022_541_15 * x;
        (y.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
    })
}
