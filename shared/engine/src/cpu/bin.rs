//! The binning pass: makes the list of splats that each tile blends, nearest first.
//!
//! Splats are sorted by depth once. The lists are filled in that order, so no list needs sorting. A splat is in the
//! lists of exactly the tiles that its ellipse (alpha of at least 1/255) touches. For this, the horizontal extent of
//! the ellipse within each row of tiles is computed in closed form. Counting and filling use the same results, the
//! spans.

use std::sync::atomic::{AtomicU32, Ordering};

use rayon::prelude::*;

use super::project::{Projected, Projection};
use crate::backend::BinCounts;
use crate::layout::constants::SLACK_PX;
use crate::layout::tiles::{TILE, TileImage};
use crate::layout::view::ViewParams;
use crate::simd::GROUP;

/// Initial capacity for spans, per splat of a run. A run is one of the [`RUNS`] groups of depth-sorted splats. If a run
/// has more spans, the memory for its spans grows, and is not shrunk afterwards.
const SPANS_PER_SPLAT: usize = 3;

/// Number of runs into which the depth-sorted splats are divided, for parallel work. The result does not depend on it.
const RUNS: usize = 16;

/// Number of splats that are copied before their spans are found. In depth order, neighbours lie far apart in memory; the
/// copies do not depend on each other, so the processor waits for several of them at once.
const BATCH: usize = 16;

/// Limit on the number of parallel jobs that fill the lists, each for some rows of tiles. The result does not depend on
/// it.
const JOBS_MAX: usize = 6;
/// Number of jobs for each thread, if there are several: pictures have more splats in some rows than in others. Every job
/// reads all spans. With six jobs on a single thread, this pass took 11 % of the time of a merge, instead of 6 %.
const JOBS_PER_THREAD: usize = 3;

/// The tiles that one splat touches in one row of tiles.
#[derive(Clone, Copy, Debug)]
struct Span {
    id: u32,
    /// First slot of the span. A slot is the place of a splat–tile pair among all pairs in depth order. Before
    /// `assign_slots` runs, this is the place among the pairs of the run.
    slot: u32,
    tile_y: u16,
    tile_x: u16,
    count: u16,
}

/// A splat that touches at least one tile, and its number of splat–tile pairs.
#[derive(Clone, Copy, Debug)]
struct Touched {
    id: u32,
    pairs: u32,
}

/// A run of splats that follow one another in depth order.
#[derive(Debug)]
struct Run {
    spans: Vec<Span>,
    touched: Vec<Touched>,
    pairs: u32,
}

/// The tile lists, and the places of each splat's pairs in them.
#[derive(Debug)]
pub(crate) struct TileLists {
    capacity: usize,
    tiles: [usize; 2],
    /// Splat ids of all lists, tile by tile, nearest first.
    ids: Vec<u32>,
    /// Tile `t` owns `ids[starts[t]..starts[t + 1]]`.
    starts: Vec<u32>,
    /// By tile: place of the next entry in `ids` while the lists are filled.
    next: Vec<u32>,
    /// By splat id: first slot and number of slots of the splat.
    slots: Vec<[u32; 2]>,
    /// By slot: index into `ids`. The slots of a splat are contiguous. Only one thread writes each entry.
    index_of_slot: Vec<AtomicU32>,
    keys: Vec<u64>,
    keys_swap: Vec<u64>,
    runs: Vec<Run>,
}

impl TileLists {
    /// Empty lists with room for `splats` splats and `pairs` splat–tile pairs on pictures up to `size_px`.
    pub(crate) fn with_capacity(splats: usize, pairs: usize, size_px: [u32; 2]) -> Self {
        let tiles: usize = TileImage::tiles_of(size_px).iter().product();
        let run_len = splats.div_ceil(RUNS);
        Self {
            capacity: pairs,
            tiles: [0, 0],
            ids: Vec::with_capacity(pairs),
            starts: Vec::with_capacity(tiles + 1),
            next: Vec::with_capacity(tiles),
            slots: Vec::with_capacity(splats.next_multiple_of(GROUP)),
            index_of_slot: Vec::with_capacity(pairs),
            keys: Vec::with_capacity(splats),
            keys_swap: Vec::with_capacity(splats),
            runs: (0..RUNS).map(|_| Run::with_capacity(run_len)).collect(),
        }
    }

    pub(crate) fn set_capacity(&mut self, pairs: usize) {
        self.capacity = pairs;
    }

    /// Makes exactly the room for `pairs` pairs.
    pub(crate) fn reserve(&mut self, pairs: usize) {
        self.ids.reserve_exact(pairs.saturating_sub(self.ids.len()));
        self.index_of_slot.reserve_exact(pairs.saturating_sub(self.index_of_slot.len()));
    }

    /// Ids of the splats that a tile blends, nearest first.
    pub(crate) fn list(&self, tile: usize) -> &[u32] {
        &self.ids[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// Tile `t` owns the pairs `starts[t]..starts[t + 1]`.
    pub(crate) fn starts(&self) -> &[u32] {
        &self.starts
    }

    pub(crate) fn pairs(&self) -> usize {
        self.ids.len()
    }

    /// Places of the pairs of splat `id` among the entries of all tile lists, in a fixed order.
    pub(crate) fn pairs_of(&self, id: usize) -> impl Iterator<Item = usize> + '_ {
        let [first, count] = self.slots[id];
        self.index_of_slot[first as usize..(first + count) as usize]
            .iter()
            .map(|index| index.load(Ordering::Relaxed) as usize)
    }

    /// Fills the lists with the visible splats.
    pub(crate) fn fill(&mut self, projection: &Projection, view: &ViewParams) -> BinCounts {
        self.tiles = view.tiles();
        self.sort_by_depth(projection);
        self.find_spans(&projection.splats, view);
        let counts = self.assign_slots(projection.splats.len());
        self.count_tiles();
        self.emit();
        counts
    }

    fn sort_by_depth(&mut self, projection: &Projection) {
        self.keys.clear();
        for (block, &visible) in projection.visible.iter().enumerate() {
            let mut left = visible;
            while left != 0 {
                let id = block * GROUP + left.trailing_zeros() as usize;
                left &= left - 1;
                // Positive floats have the same order as their bits.
                self.keys.push(u64::from(projection.depths[id].to_bits()) << 32 | id as u64);
            }
        }
        radix_sort_by_high_half(&mut self.keys, &mut self.keys_swap);
    }

    fn find_spans(&mut self, splats: &[Projected], view: &ViewParams) {
        let run_len = self.keys.len().div_ceil(RUNS).max(1);
        let keys = &self.keys;
        self.runs.par_iter_mut().enumerate().for_each(|(index, run)| {
            run.spans.clear();
            run.touched.clear();
            run.pairs = 0;
            let begin = (index * run_len).min(keys.len());
            let end = (begin + run_len).min(keys.len());
            for keys in keys[begin..end].chunks(BATCH) {
                let mut batch = [Projected::default(); BATCH];
                batch.iter_mut().zip(keys).for_each(|(copy, key)| *copy = splats[*key as u32 as usize]);
                batch.iter().zip(keys).for_each(|(splat, key)| run.add(*key as u32, splat, view));
            }
        });
    }

    /// Assigns slots to the splats in depth order. From the first splat beyond the capacity on, pairs are dropped.
    fn assign_slots(&mut self, splats: usize) -> BinCounts {
        self.slots.clear();
        self.slots.resize(splats, [0, 0]);
        let mut counts = BinCounts { visible: self.keys.len(), ..BinCounts::default() };
        let mut full = false;
        for run in &mut self.runs {
            let first_slot = counts.pairs as u32;
            for touched in &run.touched {
                full |= counts.pairs + touched.pairs as usize > self.capacity;
                if full {
                    counts.dropped += touched.pairs as usize;
                } else {
                    self.slots[touched.id as usize] = [counts.pairs as u32, touched.pairs];
                    counts.pairs += touched.pairs as usize;
                }
            }
            let kept = counts.pairs as u32;
            run.spans.iter_mut().for_each(|span| span.slot += first_slot);
            run.spans.retain(|span| span.slot < kept);
        }
        counts
    }

    fn rows_per_job(&self) -> usize {
        let jobs = match rayon::current_num_threads() {
            1 => 1,
            threads => JOBS_MAX.min(JOBS_PER_THREAD * threads),
        };
        self.tiles[1].div_ceil(jobs).max(1)
    }

    fn count_tiles(&mut self) {
        let tiles = self.tiles[0] * self.tiles[1];
        self.starts.clear();
        self.starts.resize(tiles + 1, 0);
        let tiles_x = self.tiles[0];
        let (runs, rows_per_job) = (&self.runs, self.rows_per_job());
        self.starts[1..].par_chunks_mut(tiles_x * rows_per_job).enumerate().for_each(|(job, counts)| {
            for_each_span(runs, job * rows_per_job, rows_per_job, |row, span| {
                let first = row * tiles_x + span.tile_x as usize;
                counts[first..first + span.count as usize].iter_mut().for_each(|count| *count += 1);
            });
        });
        let mut sum = 0;
        for start in &mut self.starts {
            sum += *start;
            *start = sum;
        }
    }

    fn emit(&mut self) {
        let pairs = *self.starts.last().expect("starts has tiles + 1 entries") as usize;
        self.ids.resize(pairs, 0);
        self.index_of_slot.resize_with(pairs, || AtomicU32::new(0));
        let (tiles_x, runs, starts, index_of_slot) =
            (self.tiles[0], &self.runs, &self.starts, &self.index_of_slot);
        let rows_per_job = self.rows_per_job();
        let tiles = starts.len() - 1;
        self.next.clear();
        self.next.extend_from_slice(&starts[..tiles]);
        let (mut ids, mut next) = (self.ids.as_mut_slice(), self.next.as_mut_slice());
        let mut jobs: [(&mut [u32], &mut [u32]); JOBS_MAX] = std::array::from_fn(|job| {
            let first = (job * rows_per_job * tiles_x).min(tiles);
            let end = (first + rows_per_job * tiles_x).min(tiles);
            let own = std::mem::take(&mut ids).split_at_mut((starts[end] - starts[first]) as usize);
            let own_next = std::mem::take(&mut next).split_at_mut(end - first);
            (ids, next) = (own.1, own_next.1);
            (own.0, own_next.0)
        });
        jobs.par_iter_mut().enumerate().for_each(|(job, (ids, next))| {
            let Some(&base) = next.first() else { return };
            for_each_span(runs, job * rows_per_job, rows_per_job, |row, span| {
                let first = row * tiles_x + span.tile_x as usize;
                for (k, next) in next[first..first + span.count as usize].iter_mut().enumerate() {
                    ids[(*next - base) as usize] = span.id;
                    index_of_slot[span.slot as usize + k].store(*next, Ordering::Relaxed);
                    *next += 1;
                }
            });
        });
    }
}

/// Calls `visit` with each span in the rows of tiles `first..first + rows`, nearest first, and with the row of the
/// span, counted from `first`.
fn for_each_span(runs: &[Run], first: usize, rows: usize, mut visit: impl FnMut(usize, &Span)) {
    for span in runs.iter().flat_map(|run| &run.spans) {
        let row = (span.tile_y as usize).wrapping_sub(first);
        if row < rows {
            visit(row, span);
        }
    }
}

impl Run {
    /// An empty run with room for the usual number of spans of `splats` splats.
    fn with_capacity(splats: usize) -> Self {
        Self {
            spans: Vec::with_capacity(SPANS_PER_SPLAT * splats),
            touched: Vec::with_capacity(splats),
            pairs: 0,
        }
    }

    fn add(&mut self, id: u32, splat: &Projected, view: &ViewParams) {
        let begin = self.pairs;
        visit_spans(splat, view.size_px, |tile_y, first, last| {
            let count = (last - first + 1) as u16;
            let slot = self.pairs;
            self.spans.push(Span { id, slot, tile_y: tile_y as u16, tile_x: first as u16, count });
            self.pairs += u32::from(count);
        });
        if self.pairs > begin {
            self.touched.push(Touched { id, pairs: self.pairs - begin });
        }
    }
}

/// First and last pixel `i` of `0..size` with a centre `i + 0.5` in `[low, high]`, widened by [`SLACK_PX`]; `None` if
/// there is none.
#[inline]
fn pixels_between(low: f32, high: f32, size: u32) -> Option<(usize, usize)> {
    // A cast, which truncates, is one instruction; `ceil` and `floor` are calls on baseline x86-64. Both ends are first
    // clamped to at least -1, where the terms below are equal to `ceil` and `floor`. This also replaces infinities and
    // NaN.
    let low = (low - 0.5 - SLACK_PX).max(-1.0).min(size as f32);
    let first = low as i32 + i32::from(low > (low as i32) as f32);
    let last = (high - 0.5 + SLACK_PX).max(-1.0).min(size as f32 - 1.0);
    let last = (last + 1.0) as i32 - 1;
    (first.max(0) <= last).then_some((first.max(0) as usize, last as usize))
}

/// Calls `visit(tile_y, first tile_x, last tile_x)` for each row of tiles that the ellipse of the splat (falloff of at
/// most `falloff_max`) touches.
#[inline]
fn visit_spans(splat: &Projected, size_px: [u32; 2], mut visit: impl FnMut(usize, usize, usize)) {
    let [mean_x, mean_y] = splat.mean_px;
    let [extent_x, extent_y] = splat.extent_px;
    let [half_a, b, half_c] = splat.falloff;
    let Some((top, bottom)) = pixels_between(mean_y - extent_y, mean_y + extent_y, size_px[1]) else {
        return;
    };
    // At a height of dy from the mean, the ellipse spans center * dy ± half * sqrt(1 - (dy / extent_y)²) from the mean.
    // It reaches furthest to the right at dy = rightmost, and furthest to the left at dy = -rightmost.
    let center = -0.5 * b / half_a;
    let half = (splat.falloff_max / half_a).sqrt();
    let rightmost = -0.5 * b / half_c * extent_x;
    let inv_extent_y = 1.0 / extent_y;
    let reach = |dy: f32| half * (1.0 - (dy * inv_extent_y) * (dy * inv_extent_y)).max(0.0).sqrt();
    for tile_y in top / TILE..=bottom / TILE {
        let low = (tile_y * TILE).max(top) as f32 + 0.5 - mean_y;
        let high = (tile_y * TILE + TILE - 1).min(bottom) as f32 + 0.5 - mean_y;
        let at_right = rightmost.max(low).min(high);
        let at_left = (-rightmost).max(low).min(high);
        let left = mean_x + center * at_left - reach(at_left);
        let right = mean_x + center * at_right + reach(at_right);
        if let Some((first, last)) = pixels_between(left, right, size_px[0]) {
            visit(tile_y, first / TILE, last / TILE);
        }
    }
}

/// Sorts stably by the upper 32 bits, 11 bits in each pass. Skips passes in which all keys have the same digit.
fn radix_sort_by_high_half(keys: &mut Vec<u64>, swap: &mut Vec<u64>) {
    const BITS: u32 = 11;
    const BUCKETS: usize = 1 << BITS;
    swap.clear();
    swap.resize(keys.len(), 0);
    let mut counts = [[0u32; BUCKETS]; 3];
    let digit = |key: u64, pass: usize| (key >> (32 + BITS * pass as u32)) as usize % BUCKETS;
    for &key in keys.iter() {
        for (pass, counts) in counts.iter_mut().enumerate() {
            counts[digit(key, pass)] += 1;
        }
    }
    for (pass, counts) in counts.iter_mut().enumerate() {
        if counts.iter().any(|count| *count as usize == keys.len()) {
            continue;
        }
        let mut sum = 0;
        for count in counts.iter_mut() {
            sum += std::mem::replace(count, sum);
        }
        for &key in keys.iter() {
            let place = &mut counts[digit(key, pass)];
            swap[*place as usize] = key;
            *place += 1;
        }
        std::mem::swap(keys, swap);
    }
}
