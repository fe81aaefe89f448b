//! The splats of a model as they look from straight above, in a file.
//!
//! The model need not fit into the memory. It is read twice: first only positions are kept, of as many splats at a time as
//! there is room for, to find those that float; then the others are written.
//!
//! What it knows nothing about: pictures.

use std::io;
use std::path::Path;

use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_scene::splats::SH_C0;
use cosurf_scene::{LocalFrame, SceneError, Splats, ply};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use tempfile::TempPath;

use super::error::SurveyError;
use super::lattice::{Lattice, Window};
use super::scene::Scene;
use super::tiles::Tiles;

/// A splat more than this many voxels above the surface floats: where views agree, the surface is within a voxel or two.
const FLOATING_VOXELS: f64 = 5.0;
/// A splat lies far outside of the mesh if it is more than this share of the mesh's diagonal away from its box.
const OUTSIDE_SHARE: f64 = 0.5;
/// The surface counts up to this many voxels beside a splat, so that splats at the edge of a roof do not float.
const BESIDE_VOXELS: f64 = 2.0;
/// Splats that are read at once; with harmonics of degree 3, they take a MiB.
const PART: usize = 4096;
/// Bytes for a splat while it is found out whether it floats: its position, its tile in a list and in the parts that this
/// list is joined from, its place in the order of tiles, once more while it is sorted, and in a list of those that float.
const BYTES_EACH: u64 = 48;
/// Bytes for what is read meanwhile: [`PART`] splats, and the heights of a tile and around it.
const READING_BYTES: u64 = 6 << 20;
/// The harmonics that do not vanish straight down, and their values there: those of degree 1 to 3 around the vertical axis,
/// with the signs and constants of the original 3DGS code.
const DOWN: [(usize, f32); 3] = [(2, -0.488_602_5), (6, 0.630_783_1), (12, -0.746_352_7)];

/// The splats that lie on the surface, with their colours from above only.
#[derive(Debug)]
pub(super) struct Kept {
    /// A PLY in the frame of the scene, which is removed with this value.
    file: TempPath,
    /// Whether each splat of the scene floats above the surface, or lies far outside of it.
    floats: Vec<bool>,
}

impl Kept {
    /// A PLY whose coordinates are those of the frame of the scene.
    pub(super) fn file(&self) -> &Path {
        &self.file
    }

    /// Whether each splat of the scene floats above the surface or lies far outside of it, in the order of the scene.
    pub(super) fn floats(&self) -> &[bool] {
        &self.floats
    }
}

/// Writes the splats of a scene to a file in `folder`, without those that float above the surface: no camera looks straight
/// down from above them, so nothing in training removed them, and on a map they would hide the ground. Where there is no
/// height, those above the lowest camera float. Splats far outside of the mesh go too, on all sides and below: they are
/// what cameras show behind the scene, and would make tiles that viewers never finish loading.
pub(super) fn splats_from_above(
    scene: &Scene,
    mut sieve: Sieve,
    folder: &Path,
    memory_bytes: u64,
) -> Result<Kept, SurveyError> {
    let floats = sieve.floats(scene, at_once(memory_bytes))?;
    let kept = floats.iter().filter(|floats| !**floats).count();
    // The name is one that the next survey removes if this one is killed.
    let named = tempfile::Builder::new().prefix(".splats-").suffix(".partial").tempfile_in(folder);
    let file = named.map_err(|cause| SceneError::io(folder, cause))?.into_temp_path();
    ply::write_with(&file, kept, 0, &LocalFrame::WORLD, |write| {
        let (mut read, mut written) = (0, Ok(()));
        let write_kept = |part: &Splats| {
            let mut kept = Splats::with_capacity(part.len(), 0);
            push_seen_from_above(part, &floats[read..], &mut kept);
            read += part.len();
            if written.is_ok() {
                written = write(&kept);
            }
        };
        scene.splats(PART, write_kept).map_err(io::Error::other)?;
        written
    })?;
    Ok(Kept { file, floats })
}

/// Number of splats whose positions fit into the memory at a time.
fn at_once(memory_bytes: u64) -> usize {
    let room_bytes = memory_bytes.saturating_sub(PROCESS_BYTES + READING_BYTES);
    ((room_bytes / BYTES_EACH) as usize).max(PART)
}

/// Appends splats whose colour is, from everywhere, that of `part` from straight above, without those that float.
fn push_seen_from_above(part: &Splats, floats: &[bool], splats: &mut Splats) {
    let count = part.sh_stride() / 3;
    for i in (0..part.len()).filter(|i| !floats[*i]) {
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

/// Tells which splats float.
pub(super) struct Sieve<'a> {
    frame: LocalFrame,
    lattice: &'a Lattice,
    heights: &'a mut Tiles<f32>,
    /// Edge length of a voxel, metres.
    voxel_m: f64,
    /// World height of the lowest camera, metres.
    lowest_eye_m: f64,
    /// Lowest and highest coordinates of splats that are not far outside of the mesh, in the world.
    around: [DVec3; 2],
}

impl<'a> Sieve<'a> {
    /// For a scene whose mesh lies within `bounds`, in the world.
    pub(super) fn new(
        scene: &Scene,
        lattice: &'a Lattice,
        heights: &'a mut Tiles<f32>,
        [low, high]: [DVec3; 2],
        voxel_m: f64,
    ) -> Self {
        let beside = DVec3::splat(OUTSIDE_SHARE * low.distance(high));
        let (frame, lowest_eye_m) = (scene.frame, scene.lowest_eye_m());
        Self { frame, lattice, heights, voxel_m, lowest_eye_m, around: [low - beside, high + beside] }
    }

    /// Whether each splat of the scene floats. Keeps the positions of at most `at_once` and one part.
    fn floats(&mut self, scene: &Scene, at_once: usize) -> Result<Vec<bool>, SurveyError> {
        let (mut means, mut floats, mut failed) = (Vec::new(), Vec::new(), None);
        let mut sift = |means: &mut Vec<[f32; 3]>| {
            match self.floating(means) {
                Ok(floating) => {
                    let begin = floats.len();
                    floats.resize(begin + means.len(), false);
                    floating.into_iter().for_each(|splat| floats[begin + splat as usize] = true);
                }
                Err(error) => failed = failed.take().or(Some(error)),
            }
            means.clear();
        };
        scene.splats(PART.min(at_once), |part| {
            if means.len() + part.len() > at_once {
                sift(&mut means);
            }
            means.extend_from_slice(&part.means);
        })?;
        sift(&mut means);
        failed.map_or(Ok(floats), Err)
    }

    /// Indices of the splats that float, of those at some positions.
    fn floating(&mut self, means: &[[f32; 3]]) -> Result<Vec<u32>, SurveyError> {
        let Self { frame, lattice, voxel_m, lowest_eye_m, around: [lowest, highest], .. } = *self;
        let heights = &mut *self.heights;
        let world = |splat: usize| frame.world_from_local(DVec3::from_array(means[splat].map(f64::from)));
        let map = |splat: usize| lattice.place().map_from_enu(world(splat));
        let size = DVec2::from(lattice.size_px().map(f64::from));
        let tile_of = |splat: usize| {
            let px = lattice.px_from_map(map(splat)?.truncate());
            let is_inside = px.cmpge(DVec2::ZERO).all() && px.cmplt(size).all();
            Ok::<_, SurveyError>(is_inside.then(|| heights.tile_of([px.x as u32, px.y as u32]) as u32))
        };
        let tiles: Vec<Option<u32>> =
            (0..means.len()).into_par_iter().map(tile_of).collect::<Result<_, _>>()?;
        let mut order: Vec<u32> = (0..means.len() as u32).collect();
        order.sort_by_key(|splat| tiles[*splat as usize]);
        let beside_px = BESIDE_VOXELS * voxel_m / lattice.gsd_m();
        let is_outside = |splat: u32| {
            let at = world(splat as usize);
            at.cmplt(lowest).any() || at.cmpgt(highest).any()
        };
        let mut floating = Vec::new();
        for group in order.chunk_by(|a, b| tiles[*a as usize] == tiles[*b as usize]) {
            let Some(tile) = tiles[group[0] as usize] else {
                let floats = |splat: u32| world(splat as usize).z > lowest_eye_m || is_outside(splat);
                floating.extend(group.iter().filter(|splat| floats(**splat)));
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
                if floats || is_outside(*splat) {
                    floating.push(*splat);
                }
            }
        }
        Ok(floating)
    }
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
        push_seen_from_above(&part, &[false], &mut splats);
        // The red channel: constants of the basis of 3DGS at (0, 0, -1).
        let wanted =
            0.282_094_8 * 0.01 - 0.488_602_5 * 0.07 + 0.315_391_57 * 2.0 * 0.19 - 0.373_176_34 * 2.0 * 0.37;
        assert!((splats.sh[0] * SH_C0 - wanted).abs() < 1e-6, "{} {wanted}", splats.sh[0] * SH_C0);
        assert_eq!((splats.means[0], splats.sh_degree), ([1.0, 2.0, 3.0], 0));
    }
}
