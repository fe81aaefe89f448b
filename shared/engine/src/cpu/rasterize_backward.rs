//! The backward pass of the rasterisation. It runs front to back like the forward pass, so only the finished picture
//! must be kept.
//!
//! Let `g` be the gradient with respect to the channels of a pixel. The splats behind the current splat matter only
//! through one number, `rest`: the dot product of `g` with the value that they add to the pixel. At first, `rest` is
//! the dot product of `g` with the finished pixel; then the contribution of each splat is subtracted in turn.
//!
//! Each splat–tile pair has its own [`Record`], and nothing is added across tiles here. So no atomics are needed, and
//! the order of sums does not depend on threads.

use super::bin::TileLists;
use super::project::Projected;
use super::rasterize::{PREFETCH, RowTerms, as_planes, tile_origin, touched_parts, touched_rows};
use super::records::{Record, for_each_tile};
use crate::layout::constants::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::layout::planes::{DISTANCE, NORMAL, PLANES_COLOR, PLANES_GEOMETRY, RGB};
use crate::layout::tiles::{TILE, TileImage, centers};
use crate::simd::{GROUP, Isa, Kernel, Lanes, Row, Total, prefetch};

/// First of six places in a [`Record`], which holds the gradients of one splat, summed over the pixels of one tile. The
/// six are `Σq, Σq dx, Σq dy, Σq dx², Σq dx dy, Σq dy²`, with `q = α ∂L/∂α` and `(dx, dy) = mean - pixel`, px.
pub(crate) const MOMENTS: usize = 0;
/// First of three places in a [`Record`]: ∂L/∂rgb.
pub(crate) const V_RGB: usize = 6;
/// First of three places in a [`Record`]: ∂L/∂normal.
pub(crate) const V_NORMAL: usize = 9;
/// Place in a [`Record`]: the derivative of the loss with respect to the plane distance.
pub(crate) const V_DISTANCE: usize = 12;
/// First of two places in a [`Record`]: for each screen axis, the sum over pixels of the absolute value of ∂L/∂mean,
/// times log2(e). In the other sums, opposite gradients on a large splat cancel; in these they do not.
pub(crate) const ABSOLUTE: usize = 13;

/// Computes the gradients of each splat–tile pair. `gradient` has the planes of the rendered image; its TRANSMITTANCE
/// plane holds ∂L/∂transmittance. `records` receives one record for each pair, in the order of the tile lists.
pub(crate) fn rasterize_backward(
    isa: Isa,
    lists: &TileLists,
    splats: &[Projected],
    image: &TileImage,
    gradient: &TileImage,
    blended: &[u32],
    records: &mut Vec<Record>,
) {
    let tiles = image.tiles();
    let geometry = image.planes() == PLANES_GEOMETRY;
    for_each_tile(lists, records, |tile, records| {
        let (done, untouched) = records.split_at_mut(blended[tile] as usize);
        untouched.fill(Row::ZERO);
        let input =
            TileInput { list: &lists.list(tile)[..done.len()], splats, origin: tile_origin(tile, tiles[0]) };
        let (image, gradient) = (image.tile(tile), gradient.tile(tile));
        if geometry {
            let (image, gradient) = (as_planes(image), as_planes(gradient));
            isa.run(BackwardTile::<PLANES_GEOMETRY> { input, image, gradient, records: done });
        } else {
            let (image, gradient) = (as_planes(image), as_planes(gradient));
            isa.run(BackwardTile::<PLANES_COLOR> { input, image, gradient, records: done });
        }
    });
}

struct TileInput<'a> {
    list: &'a [u32],
    splats: &'a [Projected],
    origin: [f32; 2],
}

struct BackwardTile<'a, const P: usize> {
    input: TileInput<'a>,
    image: &'a [[Row; TILE]; P],
    gradient: &'a [[Row; TILE]; P],
    records: &'a mut [Record],
}

impl<const P: usize> Kernel for BackwardTile<'_, P> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let Self { input: TileInput { list, splats, origin }, image, gradient, records } = self;
        let mut open = [Row([1.0; TILE]); TILE];
        let mut rest = finished::<L, P>(image, gradient);
        for (index, (&id, record)) in list.iter().zip(records).enumerate() {
            if let Some(next) = list.get(index + PREFETCH) {
                prefetch(splats, *next as usize);
            }
            let splat = &splats[id as usize];
            let (first, end) = touched_rows(splat, origin[1]);
            let (first_part, end_part) = touched_parts::<L>(splat, origin[0]);
            let mut sums = [Total::zero(); GROUP];
            for y in first..end {
                let (terms, dy) = RowTerms::new(splat, origin[1] + y as f32 + 0.5);
                for part in first_part..end_part {
                    let pixels = Pixels { terms, dy, origin_x: origin[0], y, part };
                    add_row::<L, P>(splat, pixels, gradient, &mut open[y], &mut rest[y], &mut sums);
                }
            }
            *record = L::sums(&sums);
        }
    }
}

/// Dot products of the finished pixels with their gradients.
#[inline(always)]
fn finished<L: Lanes, const P: usize>(image: &[[Row; TILE]; P], gradient: &[[Row; TILE]; P]) -> [Row; TILE] {
    let mut rest = [Row::ZERO; TILE];
    for (image, gradient) in image.iter().zip(gradient) {
        for (rest, (image, gradient)) in rest.iter_mut().zip(image.iter().zip(gradient)) {
            for part in 0..TILE / L::N {
                let sum = image.get::<L>(part).mul_add(gradient.get::<L>(part), rest.get::<L>(part));
                rest.set(part, sum);
            }
        }
    }
    rest
}

#[derive(Clone, Copy)]
struct Pixels {
    terms: RowTerms,
    dy: f32,
    origin_x: f32,
    y: usize,
    part: usize,
}

/// Repeats the blend of one splat into one vector of pixels, and adds the gradients of the splat to `sums`.
#[inline(always)]
fn add_row<L: Lanes, const P: usize>(
    splat: &Projected,
    pixels: Pixels,
    gradient: &[[Row; TILE]; P],
    open: &mut Row,
    rest: &mut Row,
    sums: &mut [Total<L>; GROUP],
) {
    let Pixels { terms, dy, origin_x, y, part } = pixels;
    let dx = L::splat(splat.mean_px[0]) - centers::<L>(origin_x, part);
    let Some(raw) = terms.alpha(dx) else { return };
    let hit = raw.ge(L::splat(ALPHA_MIN));
    let alpha = raw.min(L::splat(ALPHA_MAX));
    let before = open.get::<L>(part);
    let after = alpha.neg_mul_add(before, before);
    let goes_on = L::and(hit, after.ge(L::splat(TRANSMITTANCE_MIN)));
    let weight = (alpha * before).keep(goes_on);
    // A full pixel stays full: its transmittance is 0.
    let full = L::and_not(hit, goes_on);
    open.set(part, L::select(full, L::zero(), L::select(goes_on, after, before)));

    let mut value = L::zero();
    for channel in 0..3 {
        let g = gradient[RGB + channel][y].get::<L>(part);
        value = g.mul_add(L::splat(splat.rgb[channel]), value);
        sums[V_RGB + channel][part] = weight.mul_add(g, sums[V_RGB + channel][part]);
    }
    if P == PLANES_GEOMETRY {
        for axis in 0..3 {
            let g = gradient[NORMAL + axis][y].get::<L>(part);
            value = g.mul_add(L::splat(splat.normal[axis]), value);
            sums[V_NORMAL + axis][part] = weight.mul_add(g, sums[V_NORMAL + axis][part]);
        }
        let g = gradient[DISTANCE][y].get::<L>(part);
        value = g.mul_add(L::splat(splat.plane_distance), value);
        sums[V_DISTANCE][part] = weight.mul_add(g, sums[V_DISTANCE][part]);
    }
    let behind = weight.neg_mul_add(value, rest.get::<L>(part));
    rest.set(part, behind);

    // q = α ∂L/∂α = α T value - α / (1 - α) behind, with the transmittance T before the splat. It is zero where alpha
    // is clamped.
    let moves = L::and(goes_on, raw.lt(L::splat(ALPHA_MAX)));
    let odds = alpha / (L::splat(1.0) - alpha);
    let q = odds.neg_mul_add(behind, weight * value).keep(moves);
    let q_dx = q * dx;
    let dy = L::splat(dy);
    sums[MOMENTS][part] = sums[MOMENTS][part] + q;
    sums[MOMENTS + 1][part] = sums[MOMENTS + 1][part] + q_dx;
    sums[MOMENTS + 2][part] = q.mul_add(dy, sums[MOMENTS + 2][part]);
    sums[MOMENTS + 3][part] = q_dx.mul_add(dx, sums[MOMENTS + 3][part]);
    sums[MOMENTS + 4][part] = q_dx.mul_add(dy, sums[MOMENTS + 4][part]);
    sums[MOMENTS + 5][part] = (q * dy).mul_add(dy, sums[MOMENTS + 5][part]);
    let (by_x, by_y) = terms.slopes(splat, dx, dy);
    sums[ABSOLUTE][part] = sums[ABSOLUTE][part] + (q * by_x).abs();
    sums[ABSOLUTE + 1][part] = sums[ABSOLUTE + 1][part] + (q * by_y).abs();
}
