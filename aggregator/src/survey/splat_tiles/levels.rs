//! Which splats the tiles of each level have.
//!
//! Of each cell of the ground, a quarter of a leaf, a level has the most important splats: all on the level of the leaves,
//! a quarter as many on each level above. A splat's importance is what it covers: its opacity times its area. To make up for those
//! that are left out, the others are enlarged until they cover as much.
//!
//! What it knows nothing about: files.

use std::collections::BTreeMap;

use cosurf_scene::Splats;
use glam::DVec2;

use crate::survey::error::SurveyError;
use crate::survey::quadtree::{Key, key_of};
use crate::survey::scene::Scene;

/// Largest depth of a leaf: 4,096 leaves.
const DEPTH_MAX: u32 = 6;
/// Cells are so many levels below leaves.
const CELL_DEPTH: u32 = 1;
/// Of so many splats, positions are looked at to find the ground that is divided.
const SAMPLES: usize = 10_000;
/// Share of the samples beyond the divided ground on each side: few splats may be very far away. They belong to the tiles at
/// the edge.
const BEYOND: f64 = 0.01;
/// Importances are told apart by their logarithm, in bins of a quarter of an octave.
const BINS_PER_OCTAVE: f32 = 4.0;
/// Binary logarithm of the importance that the first bin begins at: a splat of 1 µm × 1 µm.
const FIRST_LOG2: f32 = -40.0;
const BINS: usize = 200;
/// Share of the splats that a level has of those of the level below.
const SHARE: f64 = 0.25;

/// Splats that are read at once.
const PART: usize = 4096;

/// The splats that do not float.
pub(super) struct Source<'a> {
    pub(super) scene: &'a Scene,
    /// For each splat of the scene: whether it floats.
    pub(super) floats: &'a [bool],
}

impl Source<'_> {
    /// Calls `visit` with parts of the model, and the index of each of their splats that does not float.
    fn each(&self, mut visit: impl FnMut(&Splats, usize)) -> Result<(), SurveyError> {
        let mut read = 0;
        self.scene.splats_in_metres(PART, |part| {
            let kept = (0..part.len()).filter(|i| !self.floats[read + i]);
            kept.for_each(|i| visit(part, i));
            read += part.len();
        })
    }
}

/// How the ground is divided.
pub(super) struct Division {
    low: DVec2,
    side: f64,
    depth: u32,
}

impl Division {
    /// The division with the fewest leaves of at most `leaf_most` splats.
    pub(super) fn of(source: &Source, leaf_most: usize) -> Result<Self, SurveyError> {
        let (low, high) = ground(source)?;
        let side = (high - low).max_element().max(f64::MIN_POSITIVE);
        let finest = Self { low, side, depth: DEPTH_MAX };
        let mut counts = vec![0usize; 1 << (2 * DEPTH_MAX)];
        source.each(|part, i| counts[finest.key(part.means[i], DEPTH_MAX) as usize] += 1)?;
        let mut depth = DEPTH_MAX;
        while depth > 0 {
            let above: Vec<usize> = counts.chunks(4).map(|four| four.iter().sum()).collect();
            if above.iter().any(|count| *count > leaf_most) {
                break;
            }
            (counts, depth) = (above, depth - 1);
        }
        Ok(Self { depth, ..finest })
    }

    /// Depth of the leaves; the root has 0.
    pub(super) fn depth(&self) -> u32 {
        self.depth
    }

    /// The tile of a depth that has a position.
    fn key(&self, at: [f32; 3], depth: u32) -> Key {
        let across = 1u32 << depth;
        let cell =
            (DVec2::new(f64::from(at[0]), f64::from(at[1])) - self.low) / self.side * f64::from(across);
        key_of(cell.to_array().map(|of| (of.max(0.0) as u32).min(across - 1)))
    }
}

/// The rectangle of x and y that has almost all splats.
fn ground(source: &Source) -> Result<(DVec2, DVec2), SurveyError> {
    let step = (source.floats.len() / SAMPLES).max(1);
    let (mut seen, mut samples) = (0, [Vec::new(), Vec::new()]);
    source.each(|part, i| {
        if seen % step == 0 {
            (0..2).for_each(|axis| samples[axis].push(part.means[i][axis]));
        }
        seen += 1;
    })?;
    let edges = samples.map(|mut values| {
        values.sort_unstable_by(f32::total_cmp);
        let beyond = (values.len() as f64 * BEYOND) as usize;
        let at = |i: usize| values.get(i).map_or(0.0, |value| f64::from(*value));
        [at(beyond), at(values.len().saturating_sub(1 + beyond))]
    });
    Ok((DVec2::new(edges[0][0], edges[1][0]), DVec2::new(edges[0][1], edges[1][1])))
}

/// How important the splats of a cell are.
#[derive(Clone)]
struct Cell {
    counts: [u32; BINS],
    /// The importance of all splats of each bin together.
    sums: [f32; BINS],
}

/// What a level has of a cell.
#[derive(Clone, Copy)]
struct Cut {
    /// The first bin of which it has splats.
    from: usize,
    /// How many splats it has of that bin, and how many there are.
    of_first: [u32; 2],
    /// How many it has in all.
    count: u32,
    /// What is added to the logarithm of the scale of each.
    larger: f32,
}

impl Cut {
    /// Whether it has a splat of a bin. `met` counts those of the first bin so far: it has some of them, evenly.
    fn has(&self, bin: usize, met: &mut u32) -> bool {
        if bin != self.from {
            return bin > self.from;
        }
        let [wanted, all] = self.of_first.map(u64::from);
        let so_far = |met: u32| u64::from(met) * wanted / all;
        *met += 1;
        so_far(*met) > so_far(*met - 1)
    }
}

impl Cell {
    /// The most important splats, this share of them.
    fn cut(&self, share: f64) -> Cut {
        let all: u32 = self.counts.iter().sum();
        let wanted = (f64::from(all) * share).ceil() as u32;
        let (mut from, mut of_first, mut count, mut sum) = (BINS, [0, 0], 0, 0.0);
        while from > 0 && count < wanted {
            from -= 1;
            let in_bin = self.counts[from];
            let taken = in_bin.min(wanted - count);
            of_first = [taken, in_bin];
            count += taken;
            sum += if in_bin > 0 { self.sums[from] * taken as f32 / in_bin as f32 } else { 0.0 };
        }
        let whole: f32 = self.sums.iter().sum();
        // Areas grow with the square of the scale.
        let larger = if count < all && sum > 0.0 { 0.5 * (whole / sum).ln().max(0.0) } else { 0.0 };
        Cut { from, of_first, count, larger }
    }
}

/// The importance of a splat, m², and its bin.
fn importance(splats: &Splats, i: usize) -> (f32, usize) {
    let mut log_scales = splats.log_scales[i];
    log_scales.sort_unstable_by(f32::total_cmp);
    let opacity = 1.0 / (1.0 + (-splats.opacity_logits[i]).exp());
    let covers = opacity * (log_scales[1] + log_scales[2]).exp();
    let bin = ((covers.log2() - FIRST_LOG2) * BINS_PER_OCTAVE).clamp(0.0, (BINS - 1) as f32);
    (covers, bin as usize)
}

/// The splats of all levels.
pub(super) struct Levels<'a> {
    division: &'a Division,
    cells: Vec<Cell>,
}

impl<'a> Levels<'a> {
    pub(super) fn of(source: &Source, division: &'a Division) -> Result<Self, SurveyError> {
        let cell_depth = division.depth + CELL_DEPTH;
        let mut cells = vec![Cell { counts: [0; BINS], sums: [0.0; BINS] }; 1 << (2 * cell_depth)];
        source.each(|part, i| {
            let cell = &mut cells[division.key(part.means[i], cell_depth) as usize];
            let (covers, bin) = importance(part, i);
            cell.counts[bin] += 1;
            cell.sums[bin] += covers;
        })?;
        Ok(Self { division, cells })
    }

    /// Number of splats of each tile of a depth that has any.
    pub(super) fn counts(&self, depth: u32) -> BTreeMap<Key, usize> {
        let mut counts = BTreeMap::new();
        for (cell, cut) in self.cuts(depth).into_iter().enumerate().filter(|(_, cut)| cut.count > 0) {
            *counts.entry(self.tile_of(cell as Key, depth)).or_default() += cut.count as usize;
        }
        counts
    }

    /// Reads the splats of some tiles of a depth, whose numbers of splats are given.
    pub(super) fn splats(
        &self,
        source: &Source,
        depth: u32,
        tiles: &BTreeMap<Key, usize>,
    ) -> Result<BTreeMap<Key, Splats>, SurveyError> {
        let sh_degree = source.scene.sh_degree()?;
        let empty = |(key, count): (&Key, &usize)| (*key, Splats::with_capacity(*count, sh_degree));
        let mut all: BTreeMap<Key, Splats> = tiles.iter().map(empty).collect();
        let cuts = self.cuts(depth);
        let mut met = vec![0; cuts.len()];
        source.each(|part, i| {
            let cell = self.division.key(part.means[i], self.division.depth + CELL_DEPTH);
            let cut = cuts[cell as usize];
            if !cut.has(importance(part, i).1, &mut met[cell as usize]) {
                return;
            }
            if let Some(splats) = all.get_mut(&self.tile_of(cell, depth)) {
                let larger = part.log_scales[i].map(|log_scale| log_scale + cut.larger);
                splats.push(part.means[i], part.quats[i], larger, part.opacity_logits[i], part.sh_of(i));
            }
        })?;
        Ok(all)
    }

    fn cuts(&self, depth: u32) -> Vec<Cut> {
        let share = SHARE.powi((self.division.depth - depth) as i32);
        self.cells.iter().map(|cell| cell.cut(share)).collect()
    }

    fn tile_of(&self, cell: Key, depth: u32) -> Key {
        cell >> (2 * (self.division.depth + CELL_DEPTH - depth))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_splats_cover_as_much() {
        let mut splats = Splats::with_capacity(0, 0);
        for i in 0..400u16 {
            let log_scale = -3.0 - 0.005 * f32::from(i);
            splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [log_scale, log_scale, -9.0], 0.0, &[0.0; 3]);
        }
        let mut cell = Cell { counts: [0; BINS], sums: [0.0; BINS] };
        let all: Vec<(f32, usize)> = (0..400).map(|i| importance(&splats, i)).collect();
        for (covers, bin) in &all {
            cell.counts[*bin] += 1;
            cell.sums[*bin] += covers;
        }
        let cut = cell.cut(1.0);
        assert!((cut.count, cut.larger) == (400, 0.0), "{} {}", cut.count, cut.larger);
        let cut = cell.cut(SHARE);
        assert_eq!(cut.count, 100);
        let mut met = 0;
        let kept: Vec<f32> =
            all.iter().filter(|(_, bin)| cut.has(*bin, &mut met)).map(|(covers, _)| *covers).collect();
        assert_eq!(kept.len(), 100);
        let covered = |of: f32, larger: f32| of * (2.0 * larger).exp();
        let sum: f32 = kept.iter().map(|covers| covered(*covers, cut.larger)).sum();
        let whole: f32 = all.iter().map(|(covers, _)| covers).sum();
        assert!((sum / whole - 1.0).abs() < 0.02, "{sum} of {whole}");
        assert_eq!(Cell { counts: [0; BINS], sums: [0.0; BINS] }.cut(SHARE).count, 0);
    }
}
