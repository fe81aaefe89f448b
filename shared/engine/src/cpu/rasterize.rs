//! The rasterisation pass: blends the splats of each tile's list, front to back.
//!
//! The 16 × 16 pixels of a tile stay in the first-level cache. A splat is blended only into the rows of pixels that its
//! ellipse touches, 4 to 16 pixels at a time, depending on the instruction set.

use rayon::prelude::*;

use super::bin::TileLists;
use super::project::Projected;
use crate::layout::constants::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::layout::planes::{DISTANCE, NORMAL, PLANES_COLOR, PLANES_GEOMETRY, RGB, TRANSMITTANCE};
use crate::layout::tiles::{TILE, TileImage, centers};
use crate::simd::{Isa, Kernel, Lanes, Row, prefetch};

/// Blends every tile. `image` must be laid out with [`PLANES_COLOR`] or [`PLANES_GEOMETRY`] planes. `blended[tile]`
/// receives the number of list entries that were processed: up to the entry after which all pixels of the tile are
/// full, or all entries.
pub(crate) fn rasterize(
    isa: Isa,
    lists: &TileLists,
    splats: &[Projected],
    image: &mut TileImage,
    blended: &mut Vec<u32>,
) {
    let tiles = image.tiles();
    blended.resize(tiles[0] * tiles[1], 0);
    let (geometry, rows_per_tile) = (image.planes() == PLANES_GEOMETRY, image.rows_per_tile());
    image.rows_mut().par_chunks_exact_mut(rows_per_tile).zip(blended.par_iter_mut()).enumerate().for_each(
        |(tile, (rows, blended))| {
            let origin = tile_origin(tile, tiles[0]);
            let list = lists.list(tile);
            *blended = if geometry {
                isa.run(BlendTile::<PLANES_GEOMETRY> { list, splats, origin, planes: as_planes_mut(rows) })
            } else {
                isa.run(BlendTile::<PLANES_COLOR> { list, splats, origin, planes: as_planes_mut(rows) })
            };
        },
    );
}

/// A tile's rows as planes of 16 rows.
fn as_planes_mut<const P: usize>(rows: &mut [Row]) -> &mut [[Row; TILE]; P] {
    rows.as_chunks_mut().0.try_into().expect("a tile has its image's planes")
}

/// A tile's rows as planes of 16 rows, like [`as_planes_mut`].
pub(crate) fn as_planes<const P: usize>(rows: &[Row]) -> &[[Row; TILE]; P] {
    rows.as_chunks().0.try_into().expect("a tile has its image's planes")
}

/// A splat is prefetched this many list entries before its turn, because splats are scattered in memory.
pub(crate) const PREFETCH: usize = 6;

/// Column and row of a tile's upper left pixel.
pub(crate) fn tile_origin(tile: usize, tiles_x: usize) -> [f32; 2] {
    [(tile % tiles_x * TILE) as f32, (tile / tiles_x * TILE) as f32]
}

/// The rows of a tile whose pixel centres are within the splat's box, as first row and end.
#[inline(always)]
pub(crate) fn touched_rows(splat: &Projected, origin_y: f32) -> (usize, usize) {
    let center = splat.mean_px[1] - origin_y - 0.5;
    let first = (center - splat.extent_px[1]).ceil().max(0.0);
    let end = ((center + splat.extent_px[1]).floor() + 1.0).min(TILE as f32);
    // A box above the tile has a negative end, which the cast turns into 0. A box below the tile has first > end. Both
    // ranges are empty.
    (first as usize, (end as usize).min(TILE))
}

/// The parts of a row (vectors of `N` pixels) that contain pixel centres within the splat's box, as first part and end.
/// If one vector holds the whole row, that part is always returned.
#[inline(always)]
pub(crate) fn touched_parts<L: Lanes>(splat: &Projected, origin_x: f32) -> (usize, usize) {
    if L::N == TILE {
        return (0, 1);
    }
    let center = splat.mean_px[0] - origin_x - 0.5;
    let first = (center - splat.extent_px[0]).ceil().max(0.0);
    let end = ((center + splat.extent_px[0]).floor() + 1.0).min(TILE as f32);
    (first as usize / L::N, (end as usize).div_ceil(L::N))
}

/// Terms of a splat's falloff that are the same for all pixels of a row.
#[derive(Clone, Copy)]
pub(crate) struct RowTerms {
    by_dx2: f32,
    by_dx: f32,
    log2_alpha: f32,
}

impl RowTerms {
    /// Terms for pixel centres at height `y_px`. Also returns `dy = mean - y`, px.
    #[inline(always)]
    pub(crate) fn new(splat: &Projected, y_px: f32) -> (Self, f32) {
        let dy = splat.mean_px[1] - y_px;
        let [xx, xy, yy] = splat.falloff;
        (Self { by_dx2: xx, by_dx: xy * dy, log2_alpha: splat.log2_opacity - yy * dy * dy }, dy)
    }

    /// Alpha `o exp(-½ dᵀ A d)` before the clamp at [`ALPHA_MAX`], with the opacity `o`, the inverse covariance `A` and
    /// the offset `d` of the mean from the pixel; `dx = mean - x`, px. `None` if no pixel of the vector reaches
    /// [`ALPHA_MIN`], which saves the exponential.
    #[inline(always)]
    pub(crate) fn alpha<L: Lanes>(&self, dx: L) -> Option<L> {
        let slope = dx.mul_add(L::splat(self.by_dx2), L::splat(self.by_dx));
        let log2_alpha = slope.neg_mul_add(dx, L::splat(self.log2_alpha));
        // This limit is slightly below log2(1/255) = -7.994. The exact test follows with alpha itself.
        let may_hit = log2_alpha.ge(L::splat(-8.0));
        // The lower limit keeps pixels that are not hit within the range of `exp2`.
        if L::any(may_hit) { Some(log2_alpha.max(L::splat(-30.0)).exp2()) } else { None }
    }
}

impl RowTerms {
    /// Derivative of the falloff with respect to the mean: `log2(e) A d`, with the inverse covariance `A` and the
    /// offset `d = (dx, dy)`.
    #[inline(always)]
    pub(crate) fn slopes<L: Lanes>(&self, splat: &Projected, dx: L, dy: L) -> (L, L) {
        let [_, xy, yy] = splat.falloff;
        let by_x = dx.mul_add(L::splat(2.0 * self.by_dx2), L::splat(self.by_dx));
        (by_x, dx.mul_add(L::splat(xy), dy * L::splat(2.0 * yy)))
    }
}

struct BlendTile<'a, const P: usize> {
    list: &'a [u32],
    splats: &'a [Projected],
    origin: [f32; 2],
    planes: &'a mut [[Row; TILE]; P],
}

impl<const P: usize> Kernel for BlendTile<'_, P> {
    /// Number of list entries that were processed.
    type Output = u32;

    #[inline(always)]
    fn run<L: Lanes>(self) -> u32 {
        let Self { list, splats, origin, planes } = self;
        *planes = [[Row::ZERO; TILE]; P];
        // Transmittance of pixels that are not full yet, and 0 for full pixels. The final transmittance of full pixels
        // is in the TRANSMITTANCE plane.
        let mut open = [Row([1.0; TILE]); TILE];
        let mut open_rows = (1u32 << TILE) - 1;
        let mut processed = list.len();
        for (index, &id) in list.iter().enumerate() {
            if let Some(next) = list.get(index + PREFETCH) {
                prefetch(splats, *next as usize);
            }
            let splat = &splats[id as usize];
            let (first, end) = touched_rows(splat, origin[1]);
            let (first_part, end_part) = touched_parts::<L>(splat, origin[0]);
            for y in first..end {
                if open_rows >> y & 1 == 0 {
                    continue;
                }
                let (terms, _) = RowTerms::new(splat, origin[1] + y as f32 + 0.5);
                for part in first_part..end_part {
                    let filled = blend::<L, P>(splat, terms, origin[0], y, part, &mut open[y], planes);
                    if filled && open[y].0.iter().all(|t| *t == 0.0) {
                        open_rows &= !(1 << y);
                    }
                }
            }
            if open_rows == 0 {
                processed = index + 1;
                break;
            }
        }
        finish::<L>(&open, &mut planes[TRANSMITTANCE]);
        processed as u32
    }
}

/// Blends one splat into one vector of pixels. Returns true if a pixel became full.
#[inline(always)]
fn blend<L: Lanes, const P: usize>(
    splat: &Projected,
    terms: RowTerms,
    origin_x: f32,
    y: usize,
    part: usize,
    open: &mut Row,
    planes: &mut [[Row; TILE]; P],
) -> bool {
    let dx = L::splat(splat.mean_px[0]) - centers::<L>(origin_x, part);
    let Some(alpha) = terms.alpha(dx) else { return false };
    let hit = alpha.ge(L::splat(ALPHA_MIN));
    let alpha = alpha.min(L::splat(ALPHA_MAX));
    let before = open.get::<L>(part);
    let after = alpha.neg_mul_add(before, before);
    let goes_on = L::and(hit, after.ge(L::splat(TRANSMITTANCE_MIN)));
    let weight = (alpha * before).keep(goes_on);
    for channel in 0..3 {
        add(&mut planes[RGB + channel][y], part, weight, splat.rgb[channel]);
    }
    if P == PLANES_GEOMETRY {
        for axis in 0..3 {
            add(&mut planes[NORMAL + axis][y], part, weight, splat.normal[axis]);
        }
        add(&mut planes[DISTANCE][y], part, weight, splat.plane_distance);
    }
    // Newly full pixels: hit, not full before, and with a transmittance that would fall below the minimum.
    let full = L::and(L::and_not(hit, goes_on), L::zero().lt(before));
    open.set(part, L::select(full, L::zero(), L::select(goes_on, after, before)));
    if L::any(full) {
        let left = &mut planes[TRANSMITTANCE][y];
        let value = L::select(full, before, left.get::<L>(part));
        left.set(part, value);
        return true;
    }
    false
}

#[inline(always)]
fn add<L: Lanes>(row: &mut Row, part: usize, weight: L, value: f32) {
    let sum = weight.mul_add(L::splat(value), row.get::<L>(part));
    row.set(part, sum);
}

/// Adds the transmittance of pixels that are not full to the TRANSMITTANCE plane, which so far holds that of full
/// pixels only.
#[inline(always)]
fn finish<L: Lanes>(open: &[Row; TILE], left: &mut [Row; TILE]) {
    for (open, left) in open.iter().zip(left) {
        for part in 0..TILE / L::N {
            let value = left.get::<L>(part) + open.get::<L>(part);
            left.set(part, value);
        }
    }
}
