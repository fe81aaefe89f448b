//! The splats of a model as they look from straight above.
//!
//! What it knows nothing about: pictures.

use cosurf_scene::splats::SH_C0;
use cosurf_scene::{LocalFrame, Splats};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::error::SurveyError;
use super::lattice::{Lattice, Window};
use super::scene::Scene;
use super::tiles::Tiles;

/// A splat more than this many voxels above the surface floats: where views agree, the surface is within a voxel or two.
const FLOATING_VOXELS: f64 = 5.0;
/// The surface counts up to this many voxels beside a splat, so that splats at the edge of a roof do not float.
const BESIDE_VOXELS: f64 = 2.0;
/// Splats that are read at once.
const PART: usize = 50_000;
/// The harmonics that do not vanish straight down, and their values there: those of degree 1 to 3 around the vertical axis,
/// with the signs and constants of the original 3DGS code.
const DOWN: [(usize, f32); 3] = [(2, -0.488_602_5), (6, 0.630_783_1), (12, -0.746_352_7)];

/// The splats that lie on the surface, with their colours from above only.
pub(super) struct Kept {
    /// In the frame of the scene.
    pub(super) splats: Splats,
    /// Number of those that float above the surface.
    pub(super) left_out: usize,
}

/// The splats of a scene, without those that float above the surface: no camera looks straight down from above them, so
/// nothing in training removed them, and on a map they would hide the ground. Where there is no height, those above the
/// lowest camera float.
pub(super) fn splats_from_above(
    scene: &Scene,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
    voxel_m: f64,
) -> Result<Kept, SurveyError> {
    let mut splats = Splats::with_capacity(0, 0);
    scene.splats(PART, |part| push_seen_from_above(part, &mut splats))?;
    let floating = floating(&splats, &scene.frame, lattice, heights, voxel_m, scene.lowest_eye_m())?;
    Ok(Kept {
        splats: if floating.is_empty() { splats } else { splats.without(&floating) },
        left_out: floating.len(),
    })
}

/// Appends splats whose colour is, from everywhere, that of `part` from straight above.
fn push_seen_from_above(part: &Splats, splats: &mut Splats) {
    let count = part.sh_stride() / 3;
    for i in 0..part.len() {
        let sh = part.sh_of(i);
        let above = |channel: usize| {
            let harmonics = DOWN.iter().filter(|(index, _)| *index < count);
            let rest: f32 = harmonics.map(|(index, value)| sh[3 * index + channel] * value).sum();
            sh[channel] + rest / SH_C0
        };
        let (mean, quat, log_scale) = (part.means[i], part.quats[i], part.log_scales[i]);
        splats.push(mean, quat, log_scale, part.opacity_logits[i], &[0, 1, 2].map(above));
    }
}

/// Indices of the splats that float, ascending.
fn floating(
    splats: &Splats,
    frame: &LocalFrame,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
    voxel_m: f64,
    lowest_eye_m: f64,
) -> Result<Vec<u32>, SurveyError> {
    let world = |splat: usize| frame.world_from_local(DVec3::from_array(splats.means[splat].map(f64::from)));
    let map = |splat: usize| lattice.place().map_from_enu(world(splat));
    let size = DVec2::from(lattice.size_px().map(f64::from));
    let tile_of = |splat: usize| {
        let px = lattice.px_from_map(map(splat)?.truncate());
        let is_inside = px.cmpge(DVec2::ZERO).all() && px.cmplt(size).all();
        Ok::<_, SurveyError>(is_inside.then(|| heights.tile_of([px.x as u32, px.y as u32]) as u32))
    };
    let tiles: Vec<Option<u32>> = (0..splats.len()).into_par_iter().map(tile_of).collect::<Result<_, _>>()?;
    let mut order: Vec<u32> = (0..splats.len() as u32).collect();
    order.sort_by_key(|splat| tiles[*splat as usize]);
    let beside_px = BESIDE_VOXELS * voxel_m / lattice.gsd_m();
    let mut floating = Vec::new();
    for group in order.chunk_by(|a, b| tiles[*a as usize] == tiles[*b as usize]) {
        let Some(tile) = tiles[group[0] as usize] else {
            floating.extend(group.iter().filter(|splat| world(**splat as usize).z > lowest_eye_m));
            continue;
        };
        let (window, around) = heights.read_around(tile as usize, beside_px.ceil() as u32 + 1)?;
        for splat in group {
            let at = map(*splat as usize)?;
            let px = lattice.px_from_map(at.truncate());
            let floats = match highest_near(&around, window, px, beside_px) {
                Some(surface_m) => at.z > surface_m + FLOATING_VOXELS * voxel_m,
                None => world(*splat as usize).z > lowest_eye_m,
            };
            if floats {
                floating.push(*splat);
            }
        }
    }
    floating.sort_unstable();
    Ok(floating)
}

/// The highest of nine heights: at a position in the map, and `beside_px` to each side of it.
fn highest_near(heights: &[f32], window: Window, px: DVec2, beside_px: f64) -> Option<f64> {
    let around = (0..9).map(|i| px + DVec2::new(f64::from(i % 3) - 1.0, f64::from(i / 3) - 1.0) * beside_px);
    let height = |at: DVec2| {
        let cell = (at - DVec2::from(window.at.map(f64::from))).floor();
        let is_inside =
            cell.cmpge(DVec2::ZERO).all() && cell.cmplt(DVec2::from(window.size.map(f64::from))).all();
        let height =
            is_inside.then(|| heights[cell.y as usize * window.size[0] as usize + cell.x as usize])?;
        (!height.is_nan()).then_some(f64::from(height))
    };
    around.filter_map(height).reduce(f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_from_above_are_those_of_the_harmonics() {
        let mut part = Splats::with_capacity(1, 3);
        let sh: Vec<f32> = (0..48).map(|i| 0.01 * (i as f32 + 1.0)).collect();
        part.push([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0], [-2.0; 3], 0.5, &sh);
        let mut splats = Splats::with_capacity(0, 0);
        push_seen_from_above(&part, &mut splats);
        // The red channel: constants of the basis of 3DGS at (0, 0, -1).
        let wanted =
            0.282_094_8 * 0.01 - 0.488_602_5 * 0.07 + 0.315_391_57 * 2.0 * 0.19 - 0.373_176_34 * 2.0 * 0.37;
        assert!((splats.sh[0] * SH_C0 - wanted).abs() < 1e-6, "{} {wanted}", splats.sh[0] * SH_C0);
        assert_eq!((splats.means[0], splats.sh_degree), ([1.0, 2.0, 3.0], 0));
    }
}
