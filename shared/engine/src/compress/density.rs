//! How densely the splats of a model lie: where its cameras observed much, training leaves many.
//!
//! On rendered Boruszyn, a model has as many splats on a square metre as another one that observed the same ground, if
//! more than ten of its cameras saw it. It has half as many if six to ten cameras saw it, 0.28 times as many with three
//! to five, 0.1 with one or two, and hardly any where no camera looked. So the splats tell whether a model observed what
//! its cameras claim.

use std::collections::HashMap;

use cosurf_scene::Splats;
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::slopes::{SLOPES_PX, cube};

/// Opaque splats count this much; others less, by their opacity.
const OPAQUE: f64 = 255.0;

/// For each cube with splats, the sum of their opacities, in units of 1 / [`OPAQUE`]. Whole numbers give the same sums in
/// any order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Counts {
    /// Side of a cube, world units.
    side: f64,
    cubes: HashMap<[i64; 3], u64>,
}

/// The density of a model's splats around each cube, beside the density that is usual in the model.
#[derive(Clone, Debug)]
pub struct Density {
    side: f64,
    /// Sums over each cube and the 26 cubes around it. The surface may lie on both sides of the face of a cube.
    around: HashMap<[i64; 3], u64>,
    /// The median of the sums around all splats; at least 1.
    usual: u64,
}

impl Counts {
    /// The sums of a model's `counted` splats. `side` is the side of a cube, world units, above 0.
    pub(super) fn of(splats: &Splats, counted: impl Iterator<Item = usize>, side: f64) -> Self {
        let mut cubes = HashMap::new();
        for i in counted {
            let opacity = 1.0 / (1.0 + libm::exp(f64::from(-splats.opacity_logits[i])));
            let mean = DVec3::from_array(splats.means[i].map(f64::from));
            *cubes.entry(cube(mean, side)).or_insert(0) += (OPAQUE * opacity).round() as u64;
        }
        Self { side, cubes }
    }
}

impl Density {
    /// The density of a model whose pictures have pixels of this width on the ground, world units, above 0.
    pub fn of(splats: &Splats, pixel_m: f64) -> Self {
        Self::from(&Counts::of(splats, 0..splats.len(), SLOPES_PX * pixel_m))
    }

    /// The density around `place`, as a multiple of the usual one.
    pub fn at(&self, place: DVec3) -> f64 {
        let sum = self.around.get(&cube(place, self.side)).copied().unwrap_or(0);
        sum as f64 / self.usual as f64
    }
}

impl From<&Counts> for Density {
    fn from(Counts { side, cubes }: &Counts) -> Self {
        let mut around: HashMap<[i64; 3], u64> = HashMap::new();
        for (cube, count) in cubes {
            for near in neighbours(*cube) {
                *around.entry(near).or_insert(0) += count;
            }
        }
        let mut sums: Vec<[u64; 2]> = cubes.iter().map(|(cube, count)| [around[cube], *count]).collect();
        sums.sort_unstable();
        let half = sums.iter().map(|[_, count]| count).sum::<u64>() / 2;
        let mut passed = 0;
        let middle = sums.iter().find(|[_, count]| {
            passed += count;
            passed > half
        });
        Self { side: *side, around, usual: middle.map_or(1, |[sum, _]| *sum).max(1) }
    }
}

/// A cube and the 26 cubes around it.
fn neighbours([x, y, z]: [i64; 3]) -> impl Iterator<Item = [i64; 3]> {
    let near = |at: i64| at.saturating_sub(1)..=at.saturating_add(1);
    near(x).flat_map(move |x| near(y).flat_map(move |y| near(z).map(move |z| [x, y, z])))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Splats on a square, `across` of them along each side of 10 world units, at the height of a face between cubes.
    fn square(x: f32, across: usize) -> Splats {
        let mut splats = Splats::with_capacity(0, 0);
        for i in 0..across * across {
            let [u, v] = [i % across, i / across].map(|at| (at as f32 + 0.5) * 10.0 / across as f32);
            let above = if i % 2 == 0 { 0.01 } else { -0.01 };
            splats.push([x + u, v, above], [1.0, 0.0, 0.0, 0.0], [-3.0; 3], 6.0, &[0.0; 3]);
        }
        splats
    }

    fn of_all(splats: &Splats) -> Density {
        Density::from(&Counts::of(splats, 0..splats.len(), 1.0))
    }

    #[test]
    fn density_is_a_multiple_of_what_is_usual_in_the_model() {
        let mut splats = square(0.0, 40);
        splats.extend(&square(20.0, 10));
        let density = of_all(&splats);
        let at = |x: f64| density.at(DVec3::new(x, 5.0, 0.0));
        assert!((at(5.0) - 1.0).abs() < 0.1, "{}", at(5.0));
        assert!((at(25.0) - 1.0 / 16.0).abs() < 0.02, "{}", at(25.0));
        assert_eq!(at(15.0), 0.0);
    }

    #[test]
    fn splats_that_nobody_sees_do_not_make_a_model_dense() {
        let mut splats = square(0.0, 40);
        let mut faint = square(20.0, 40);
        faint.opacity_logits.fill(-9.0);
        splats.extend(&faint);
        assert_eq!(of_all(&splats).at(DVec3::new(25.0, 5.0, 0.0)), 0.0);
        assert_eq!(of_all(&Splats::default()).at(DVec3::ZERO), 0.0);
    }
}
