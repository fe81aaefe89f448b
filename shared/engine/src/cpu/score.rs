//! The scoring pass: computes the contribution of each splat to a picture. It repeats the blend without colours. Like
//! the backward pass, it writes one record for each splat–tile pair. Then one thread sums all records of a splat in a
//! fixed order.

use rayon::prelude::*;

use super::bin::TileLists;
use super::blocks::Blocks;
use super::project::{Projected, Projection};
use super::rasterize::{RowTerms, tile_origin, touched_parts, touched_rows};
use super::records::{Record, for_each_tile};
use crate::layout::constants::{ALPHA_MAX, ALPHA_MIN, OBSERVED_TRANSMITTANCE, TRANSMITTANCE_MIN};
use crate::layout::rows::{HITS, OBSERVED, SCORE_ROWS, SQUARED_WEIGHT};
use crate::layout::tiles::{TILE, TileImage, centers};
use crate::simd::{GROUP, Isa, Kernel, Lanes, Row, Total};

/// Writes the records of the last blended picture. In that picture, tile `t` processed `blended[t]` entries of its
/// list.
pub(crate) fn score(
    isa: Isa,
    lists: &TileLists,
    splats: &[Projected],
    image: &TileImage,
    blended: &[u32],
    records: &mut Vec<Record>,
) {
    for_each_tile(lists, records, |tile, records| {
        let (done, untouched) = records.split_at_mut(blended[tile] as usize);
        untouched.fill(Row::ZERO);
        let list = &lists.list(tile)[..done.len()];
        let origin = tile_origin(tile, image.tiles()[0]);
        isa.run(ScoreTile { list, splats, origin, open: inside(origin, image.size_px()), records: done });
    });
}

/// Adds the records to the scores of their splats.
pub(crate) fn collect(projection: &Projection, lists: &TileLists, records: &[Record], scores: &mut Blocks) {
    scores.rows_mut().par_chunks_exact_mut(SCORE_ROWS).enumerate().with_min_len(64).for_each(
        |(block, rows)| {
            let visible = projection.visible[block];
            for lane in (0..GROUP).filter(|lane| visible >> lane & 1 == 1) {
                let mut total = [0.0; SCORE_ROWS];
                for pair in lists.pairs_of(block * GROUP + lane) {
                    for (total, value) in total.iter_mut().zip(records[pair].0) {
                        *total += value;
                    }
                }
                rows[SQUARED_WEIGHT].0[lane] += total[SQUARED_WEIGHT];
                rows[HITS].0[lane] += total[HITS];
                rows[OBSERVED].0[lane] += f32::from(u8::from(total[OBSERVED] > 0.0));
            }
        },
    );
}

/// Whether any of the first `first` splats is visible, and has no hits yet.
pub(crate) fn may_add_hits(projection: &Projection, scores: &Blocks, first: usize) -> bool {
    let is_new =
        |i: usize| projection.visible[i / GROUP] >> (i % GROUP) & 1 == 1 && scores.value(i, HITS) == 0.0;
    (0..first).any(is_new)
}

/// Transmittance of a tile's pixels before the first splat: 1 inside the picture, 0 outside.
fn inside(origin: [f32; 2], size_px: [usize; 2]) -> [Row; TILE] {
    let left = |axis: usize| size_px[axis].saturating_sub(origin[axis] as usize).min(TILE);
    let mut open = [Row::ZERO; TILE];
    for row in &mut open[..left(1)] {
        row.0[..left(0)].fill(1.0);
    }
    open
}

struct ScoreTile<'a> {
    list: &'a [u32],
    splats: &'a [Projected],
    origin: [f32; 2],
    /// Transmittance of each pixel of the tile; 0 if the pixel is full or outside the picture.
    open: [Row; TILE],
    records: &'a mut [Record],
}

impl Kernel for ScoreTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let Self { list, splats, origin, mut open, records } = self;
        for (&id, record) in list.iter().zip(records) {
            let splat = &splats[id as usize];
            let (first, end) = touched_rows(splat, origin[1]);
            let (first_part, end_part) = touched_parts::<L>(splat, origin[0]);
            let mut sums = [Total::zero(); SCORE_ROWS];
            for y in first..end {
                let (terms, _) = RowTerms::new(splat, origin[1] + y as f32 + 0.5);
                for part in first_part..end_part {
                    let dx = L::splat(splat.mean_px[0]) - centers::<L>(origin[0], part);
                    if let Some(alpha) = terms.alpha(dx) {
                        add(alpha, part, &mut open[y], &mut sums);
                    }
                }
            }
            record.0[..SCORE_ROWS].copy_from_slice(&[sums[0].sum(), sums[1].sum(), sums[2].sum()]);
        }
    }
}

/// Repeats the blend of one splat into one vector of pixels, and adds the contribution of the splat to `sums`.
#[inline(always)]
fn add<L: Lanes>(alpha: L, part: usize, open: &mut Row, sums: &mut [Total<L>; SCORE_ROWS]) {
    let one = L::splat(1.0);
    let hit = alpha.ge(L::splat(ALPHA_MIN));
    let alpha = alpha.min(L::splat(ALPHA_MAX));
    let before = open.get::<L>(part);
    let after = alpha.neg_mul_add(before, before);
    let goes_on = L::and(hit, after.ge(L::splat(TRANSMITTANCE_MIN)));
    let full = L::and_not(hit, goes_on);
    open.set(part, L::select(full, L::zero(), L::select(goes_on, after, before)));
    let clear = L::and(goes_on, L::splat(OBSERVED_TRANSMITTANCE).lt(before));
    let weight = (alpha * before).keep(goes_on);
    sums[SQUARED_WEIGHT][part] = weight.mul_add(weight, sums[SQUARED_WEIGHT][part]);
    sums[HITS][part] = sums[HITS][part] + one.keep(goes_on);
    sums[OBSERVED][part] = sums[OBSERVED][part] + one.keep(clear);
}
