//! How wrong each height may be, and which heights are none.
//!
//! The factors below were fitted to two scenes whose surface is known, by quantile regression: the built-in city, of its
//! photographs, and a village (`gt_boruszyn`). At 75 % and 63 % of their pixels, the error is smaller than the one that is
//! claimed. Large errors are more frequent than in a normal distribution.
//!
//! What it knows nothing about: files; how heights were found.
//!
//! Where to start reading: [`find_claims`].

use bytemuck::{Pod, Zeroable};

use super::error::SurveyError;
use super::lattice::{Lattice, Window};
use super::tiles::Tiles;
use super::views::Views;

/// Fewest views that must show a height. Heights that two views show erred by 3 m in the city.
const VIEWS_LEAST: f32 = 3.0;
/// At most one view for this many that show a height may look through it. Otherwise it floats: heights above that erred by
/// 3 m to 11 m in the city.
const SHOWN_FOR_EACH_THROUGH: f32 = 4.0;
/// Error of heights that all views agree on, as a share of a pixel.
const LEAST_PIXELS: f64 = 0.1;
/// Error for each metre of spread, with many views. It is no mean of independent errors: all views show the same splats.
const FOR_SPREAD: f64 = 0.55;
/// With this many views, the error for the spread doubles, and with fewer it grows further: few views may all be wrong in the
/// same way.
const FEW_VIEWS: f64 = 9.5;
/// Error for each metre between the lowest and the highest surface around: at edges, a surface that lies a pixel beside its
/// place has the height of another.
const FOR_RANGE: f64 = 0.14;
/// The lowest and the highest surface are looked for up to this many voxels away, along each axis of the map.
const AROUND_VOXELS: f64 = 2.0;
/// Error in voxels, if all views looked through the surface.
const FOR_THROUGH_VOXELS: f64 = 16.0;

/// What is claimed of a height.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Claim {
    /// Number of views that show it; 0 if it is no height.
    pub(super) views: f32,
    /// Root mean square of the differences between the heights that these views show and the one that was found, metres.
    pub(super) spread_m: f32,
    /// The error is smaller than this at about 68 % of such pixels, metres.
    pub(super) error_m: f32,
}

/// Finds what can be claimed of each height, and returns the median of the errors, metres; `None` if nothing can be claimed.
/// Heights of which nothing can be claimed become NaN.
pub(super) fn find_claims(
    lattice: &Lattice,
    voxel_m: f64,
    heights: &mut Tiles<f32>,
    views: &mut Tiles<Views>,
    claims: &mut Tiles<Claim>,
) -> Result<Option<f64>, SurveyError> {
    let scale = Scale::of(lattice, voxel_m);
    let around_px = (AROUND_VOXELS * voxel_m / lattice.gsd_m()).round().max(1.0) as u32;
    let mut errors_m = Vec::new();
    // All of them first: the heights around matter, too.
    for tile in 0..heights.len() {
        let (around, surface) = heights.read_around(tile, around_px)?;
        let ranges_m = ranges(&surface, around, heights.window(tile), around_px as usize);
        let of_tile: Vec<Claim> = views
            .read(tile)?
            .iter()
            .zip(ranges_m)
            .map(|(views, range_m)| scale.claim(views, range_m))
            .collect();
        claims.write(tile, &of_tile)?;
        errors_m
            .extend(of_tile.iter().filter(|claim| claim.views > 0.0).step_by(16).map(|claim| claim.error_m));
    }
    for tile in 0..heights.len() {
        let mut values = heights.read(tile)?;
        for (height, claim) in values.iter_mut().zip(claims.read(tile)?) {
            if claim.views == 0.0 {
                *height = f32::NAN;
            }
        }
        heights.write(tile, &values)?;
    }
    let middle = errors_m.len() / 2;
    Ok((!errors_m.is_empty()).then(|| f64::from(*errors_m.select_nth_unstable_by(middle, f32::total_cmp).1)))
}

/// The lengths that errors are counted in.
pub(super) struct Scale {
    /// Side of a pixel of the map, metres.
    pub(super) gsd_m: f64,
    /// Edge length of a voxel, metres.
    pub(super) voxel_m: f64,
}

impl Scale {
    /// Of a map, and of a surface with voxels of `voxel_m`.
    pub(super) fn of(lattice: &Lattice, voxel_m: f64) -> Self {
        Self { gsd_m: lattice.gsd_m(), voxel_m }
    }

    /// What can be claimed of a height with these views, if the surfaces around differ by `range_m` metres.
    pub(super) fn claim(&self, views: &Views, range_m: f32) -> Claim {
        let Some(spread_m) = views.spread_m() else { return Claim::default() };
        if views.count < VIEWS_LEAST || SHOWN_FOR_EACH_THROUGH * views.through > views.count {
            return Claim::default();
        }
        let [count, through] = [views.count, views.through].map(f64::from);
        let parts = [
            LEAST_PIXELS * self.gsd_m,
            FOR_SPREAD * f64::from(spread_m) * (1.0 + (FEW_VIEWS / count).powi(2)),
            FOR_RANGE * f64::from(range_m),
            FOR_THROUGH_VOXELS * self.voxel_m * through / (count + through),
        ];
        let error_m = parts.iter().map(|part| part * part).sum::<f64>().sqrt() as f32;
        Claim { views: views.count, spread_m, error_m }
    }
}

/// For each pixel of a window, the difference between the highest and the lowest height up to `reach_px` away along each axis,
/// metres; `heights` are those of the window `around` it. 0 where there is none.
fn ranges(heights: &[f32], around: Window, window: Window, reach_px: usize) -> Vec<f32> {
    let [width, rows] = around.size.map(|side| side as usize);
    let join = |a: [f32; 2], b: [f32; 2]| [a[0].min(b[0]), a[1].max(b[1])]; // neither takes NaN
    let near = |at: usize, end: usize| at.saturating_sub(reach_px)..(at + reach_px + 1).min(end);
    let along: Vec<[f32; 2]> = (0..heights.len())
        .map(|i| {
            let row = i / width * width;
            near(i % width, width).map(|x| [heights[row + x]; 2]).fold([f32::NAN; 2], join)
        })
        .collect();
    let [left, top] = [0, 1].map(|axis| (window.at[axis] - around.at[axis]) as usize);
    let range = |i: usize| {
        let [x, y] = [left + i % window.size[0] as usize, top + i / window.size[0] as usize];
        let [low, high] = near(y, rows).map(|y| along[y * width + x]).fold([f32::NAN; 2], join);
        if low.is_nan() { 0.0 } else { high - low }
    };
    (0..window.pixels()).map(range).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::lattice::tests::lattice;
    use super::*;

    const SCALE: Scale = Scale { gsd_m: 0.1, voxel_m: 0.1 };

    fn error_m(count: f32, through: f32, spread_m: f32, range_m: f32) -> f32 {
        SCALE.claim(&Views::of(count, through, spread_m), range_m).error_m
    }

    #[test]
    fn heights_that_few_views_show_or_many_look_through_are_none() {
        assert_eq!(SCALE.claim(&Views::of(2.0, 0.0, 0.01), 0.0), Claim::default());
        assert_eq!(SCALE.claim(&Views::of(11.0, 3.0, 0.01), 0.0), Claim::default());
        assert_eq!(SCALE.claim(&Views::of(0.0, 0.0, 0.0), 0.0), Claim::default());
        let claim = SCALE.claim(&Views::of(12.0, 3.0, 0.0), 0.0);
        assert!(claim.views == 12.0 && (claim.error_m - 0.32).abs() < 0.001, "{claim:?}");
    }

    #[test]
    fn claims_grow_with_spread_edges_and_fewer_views() {
        let many = error_m(50.0, 0.0, 0.1, 0.0);
        assert!((many - 0.0578).abs() < 0.001, "{many}");
        assert!(error_m(50.0, 0.0, 0.2, 0.0) > 1.8 * many);
        assert!(error_m(4.0, 0.0, 0.1, 0.0) > 5.0 * many);
        assert!(error_m(50.0, 0.0, 0.1, 8.0) > 1.0);
        assert_eq!(error_m(50.0, 0.0, 0.0, 0.0), 0.01);
    }

    #[test]
    fn heights_without_a_claim_go_and_edges_count_across_tiles() {
        let folder = tempfile::tempdir().unwrap();
        let lattice = lattice([0.0, 0.0], [6.3, 0.3], 0.1);
        let size_px = lattice.size_px();
        let mut heights = Tiles::new(folder.path(), size_px, 32).unwrap();
        let mut views = Tiles::new(folder.path(), size_px, 32).unwrap();
        let mut claims = Tiles::new(folder.path(), size_px, 32).unwrap();
        for tile in 0..heights.len() {
            let window = heights.window(tile);
            // The first tile is 5 m lower than the others, and two views show its first pixel.
            heights.write(tile, &vec![if tile == 0 { 70.0 } else { 75.0 }; window.pixels()]).unwrap();
            let mut of_tile = vec![Views::of(20.0, 0.0, 0.0); window.pixels()];
            if tile == 0 {
                of_tile[0] = Views::of(2.0, 0.0, 0.0);
            }
            views.write(tile, &of_tile).unwrap();
        }
        let median_m = find_claims(&lattice, 0.1, &mut heights, &mut views, &mut claims).unwrap();
        assert!((median_m.unwrap() - 0.01).abs() < 1e-6);
        let (surface, claimed) = (heights.read(0).unwrap(), claims.read(0).unwrap());
        assert!(surface[0].is_nan() && surface[1] == 70.0);
        assert_eq!(claimed[0], Claim::default());
        assert!((claimed[29].error_m - 0.01).abs() < 1e-6 && (claimed[30].error_m - 0.7).abs() < 0.01);
    }
}
