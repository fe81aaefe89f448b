//! The colour loss `(1 - λ) L1 + λ (1 - SSIM)` and its gradient, in one sweep over the picture. L1 compares the
//! rendering after the exposure is applied, SSIM the rendering itself.
//!
//! SSIM is that of 3DGS: an 11 × 11 Gaussian window, σ = 1.5 px, zeros outside the picture. The window is separable.
//! After the horizontal filter, the lines of a band of the picture pass through ring buffers of 11 lines: five buffers
//! for the moments of SSIM ([`MOMENT_LINES`]) and three for its partial derivatives ([`PARTIAL_LINES`]). So scratch
//! memory does not grow with the height of the picture, and at usual widths it fits into the second-level cache.

use rayon::prelude::*;

use super::scratch::PerThread;
use crate::backend::{Exposure, PhotometricLoss, TargetRgb};
use crate::layout::constants::{
    SSIM_C1 as C1, SSIM_C2 as C2, SSIM_REACH as REACH, SSIM_TAPS as TAPS, ssim_window,
};
use crate::layout::planes::{RGB, TRANSMITTANCE};
use crate::layout::tiles::{TILE, TileImage};
use crate::simd::{GROUP, Isa, Kernel, Lanes, Row, Total, each};

/// Number of rows of tiles in a band. Bands do not depend on the number of threads, so the sums do not either.
const BAND_TILES: usize = 2;
/// Number of zeros to the left and to the right of a line: at least [`REACH`], and a multiple of [`GROUP`].
const MARGIN: usize = GROUP;

/// The colour loss with its scratch memory.
#[derive(Debug)]
pub(crate) struct Photometric {
    scratch: PerThread<Scratch>,
    /// Sums of each band.
    sums: Vec<Sums>,
}

impl Photometric {
    /// Scratch memory for pictures up to `size_px` and this many threads, at least 1.
    pub(crate) fn with_capacity(size_px: [u32; 2], threads: usize) -> Self {
        let [tiles_x, tiles_y] = TileImage::tiles_of(size_px);
        Self {
            scratch: PerThread::new(threads, || Scratch::with_capacity(tiles_x * TILE)),
            sums: Vec::with_capacity(tiles_y.div_ceil(BAND_TILES)),
        }
    }

    /// Returns the loss and writes its gradient to the colour planes of `gradient`. All other planes become zero; the
    /// loss does not depend on transmittance, because the background is black. `gradient` must have the same shape as
    /// `image`.
    pub(crate) fn loss(
        &mut self,
        isa: Isa,
        image: &TileImage,
        target: TargetRgb,
        exposure: Exposure,
        ssim_weight: f32,
        gradient: &mut TileImage,
    ) -> PhotometricLoss {
        let [width, height] = image.size_px();
        let pixels = 3.0 * width as f32 * height as f32;
        let weights =
            Weights { window: ssim_window(), l1: (1.0 - ssim_weight) / pixels, ssim: ssim_weight / pixels };
        let band_rows = image.tiles()[0] * image.rows_per_tile() * BAND_TILES;
        let is_masked = target.is_masked();
        let Self { scratch, sums } = self;
        sums.resize(image.tiles()[1].div_ceil(BAND_TILES), Sums::default());
        gradient.rows_mut().par_chunks_mut(band_rows).zip(sums.par_iter_mut()).enumerate().for_each(
            |(band, (rows, sums))| {
                rows.chunks_exact_mut(image.rows_per_tile())
                    .for_each(|tile| tile[TRANSMITTANCE * TILE..].fill(Row::ZERO));
                *sums = scratch.with(|scratch| {
                    (0..3).fold(Sums::default(), |sums, channel| {
                        let gradient = &mut *rows;
                        let scratch = &mut *scratch;
                        let input = Input { image, target, is_masked, exposure, weights, channel, band };
                        sums.plus(isa.run(Band { input, gradient, scratch }))
                    })
                });
            },
        );
        // Added in the order of the bands, so that the sum does not depend on threads.
        let total = sums.iter().copied().fold(Sums::default(), Sums::plus);
        let pixels = f64::from(pixels);
        let (l1, ssim, mse) = (total.l1 / pixels, total.ssim / pixels, total.squares / pixels);
        let weight = f64::from(ssim_weight);
        PhotometricLoss {
            total: (1.0 - weight) * l1 + weight * (1.0 - ssim),
            l1,
            ssim,
            mse,
            by_gain: (1.0 - weight) * total.signed_x / pixels,
            by_offset: (1.0 - weight) * total.signs / pixels,
        }
    }
}

/// Number of lines with margins that a band needs: the rendering, the photograph, the exposed rendering, three products
/// and three partial derivatives, and which pixels count.
const LINES: usize = 10;

/// Memory of one thread for the lines and ring buffers of a band.
#[derive(Debug)]
struct Scratch(Vec<f32>);

/// The lines and ring buffers of one band. They are slices, not vectors, and the compiler sees their lengths. So it
/// keeps their addresses in registers and leaves bounds checks out of the loops.
struct Lines<'a> {
    x_line: &'a mut [f32],
    y_line: &'a mut [f32],
    exposed_line: &'a mut [f32],
    /// 1 for pixels that count, 0 for masked ones.
    counted_line: &'a mut [f32],
    products: [&'a mut [f32]; 3],
    partial_lines: [&'a mut [f32]; 3],
    moments: Ring<'a, MOMENT_LINES>,
    partials: Ring<'a, PARTIAL_LINES>,
}

impl Scratch {
    /// Memory for pictures whose width, rounded up to whole tiles, is at most `padded`.
    fn with_capacity(padded: usize) -> Self {
        Self(Vec::with_capacity(Self::len(padded)))
    }

    fn len(padded: usize) -> usize {
        LINES * (padded + 2 * MARGIN) + (MOMENT_LINES + PARTIAL_LINES) * TAPS * padded
    }

    /// Divides the memory into lines and ring buffers for pictures of this width. The lines are zero, margins included.
    /// The ring buffers keep old numbers, because each of their lines is written before it is read.
    #[inline(always)]
    fn lines(&mut self, padded: usize) -> Lines<'_> {
        let line_len = padded + 2 * MARGIN;
        self.0.resize(Self::len(padded), 0.0);
        let rest = &mut self.0[..];
        rest[..LINES * line_len].fill(0.0);
        let (x_line, rest) = rest.split_at_mut(line_len);
        let (y_line, rest) = rest.split_at_mut(line_len);
        let (exposed_line, rest) = rest.split_at_mut(line_len);
        let (counted_line, rest) = rest.split_at_mut(line_len);
        counted_line.fill(1.0);
        let (products, rest) = three(rest, line_len);
        let (partial_lines, rest) = three(rest, line_len);
        let (moments, rest) = rest.split_at_mut(MOMENT_LINES * TAPS * padded);
        let (partials, _) = rest.split_at_mut(PARTIAL_LINES * TAPS * padded);
        let (moments, partials) =
            (Ring { width: padded, data: moments }, Ring { width: padded, data: partials });
        Lines { x_line, y_line, exposed_line, counted_line, products, partial_lines, moments, partials }
    }
}

/// Splits off three lines of `len` numbers each; also returns the rest.
#[inline(always)]
fn three(rest: &mut [f32], len: usize) -> ([&mut [f32]; 3], &mut [f32]) {
    let (a, rest) = rest.split_at_mut(len);
    let (b, rest) = rest.split_at_mut(len);
    let (c, rest) = rest.split_at_mut(len);
    ([a, b, c], rest)
}

#[derive(Clone, Copy)]
struct Weights {
    window: [f32; TAPS],
    l1: f32,
    ssim: f32,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    l1: f64,
    ssim: f64,
    squares: f64,
    /// Sum of the signs of the differences in L1.
    signs: f64,
    /// Sum of the rendered colours, each times the sign of its difference in L1.
    signed_x: f64,
}

impl Sums {
    fn plus(self, other: Self) -> Self {
        Self {
            l1: self.l1 + other.l1,
            ssim: self.ssim + other.ssim,
            squares: self.squares + other.squares,
            signs: self.signs + other.signs,
            signed_x: self.signed_x + other.signed_x,
        }
    }
}

/// Computes loss and gradient of one channel in one band.
struct Band<'a> {
    input: Input<'a>,
    gradient: &'a mut [Row],
    scratch: &'a mut Scratch,
}

/// What a band reads.
#[derive(Clone, Copy)]
struct Input<'a> {
    image: &'a TileImage,
    target: TargetRgb<'a>,
    is_masked: bool,
    exposure: Exposure,
    weights: Weights,
    channel: usize,
    band: usize,
}

/// Number of filtered moments: x, y, xx, yy and xy, with the rendering x and the photograph y.
const MOMENT_LINES: usize = 5;
/// Number of filtered partial derivatives: ∂SSIM/∂μx, ∂SSIM/∂E[xx] and ∂SSIM/∂E[xy].
const PARTIAL_LINES: usize = 3;

/// `LINES` ring buffers of 11 lines each.
struct Ring<'a, const LINES: usize> {
    width: usize,
    data: &'a mut [f32],
}

impl<const LINES: usize> Ring<'_, LINES> {
    /// The line for picture row `y` in ring buffer `line`. Row `y` may be above the picture.
    #[inline(always)]
    fn at(&self, line: usize, y: isize) -> &[f32] {
        &self.data[(line * TAPS + y.rem_euclid(TAPS as isize) as usize) * self.width..][..self.width]
    }

    fn at_mut(&mut self, line: usize, y: isize) -> &mut [f32] {
        &mut self.data[(line * TAPS + y.rem_euclid(TAPS as isize) as usize) * self.width..][..self.width]
    }

    /// The lines that the vertical filter reads for picture row `y`.
    #[inline(always)]
    fn taps(&self, y: isize) -> [[&[f32]; TAPS]; LINES] {
        std::array::from_fn(|line| std::array::from_fn(|k| self.at(line, y + k as isize - REACH as isize)))
    }
}

/// Applies the vertical filter to the columns of one vector, which starts at column `x`.
#[inline(always)]
fn filtered_column<L: Lanes>(taps: &[&[f32]; TAPS], x: usize, window: &[f32; TAPS]) -> L {
    let mut sum = L::zero();
    for (line, weight) in taps.iter().zip(window) {
        sum = L::splat(*weight).mul_add(L::load(&line[x..]), sum);
    }
    sum
}

/// Applies the horizontal filter to one vector of a line, which starts at column `x` of the picture. The line has
/// [`MARGIN`] zeros on both sides.
#[inline(always)]
fn filtered_row<L: Lanes>(line: &[f32], x: usize, window: &[f32; TAPS]) -> L {
    let first = MARGIN + x - REACH;
    let mut sum = L::zero();
    for (k, weight) in window.iter().enumerate() {
        sum = L::splat(*weight).mul_add(L::load(&line[first + k..]), sum);
    }
    sum
}

impl Kernel for Band<'_> {
    type Output = Sums;

    #[inline(always)]
    fn run<L: Lanes>(self) -> Sums {
        let Self { input, gradient, scratch } = self;
        let [first, end] = input.rows().map(|row| row as isize);
        let mut lines = scratch.lines(input.padded());
        let mut sums = Sums::default();
        let reach = REACH as isize;
        // Once row `y_in` is read, the partial derivatives of row `y_in - 5` and the gradient of row `y_in - 10` can be
        // computed.
        for y_in in first - 2 * reach..end + 2 * reach {
            input.filter_moments::<L>(y_in, &mut lines);
            let y_map = y_in - reach;
            if y_map < first - reach {
                continue;
            }
            let ssim = input.filter_partials::<L>(y_map, &mut lines);
            if (first..end).contains(&y_map) {
                sums.ssim += ssim;
            }
            let y_out = y_map - reach;
            if (first..end).contains(&y_out) {
                sums = sums.plus(input.write_gradient::<L>(y_out as usize, &mut lines, gradient));
            }
        }
        zero_below(gradient, input.image, input.channel, (end - first) as usize);
        sums
    }
}

impl Input<'_> {
    /// The first row of the band, and the first row behind it.
    #[inline(always)]
    fn rows(self) -> [usize; 2] {
        let first = self.band * BAND_TILES * TILE;
        [first, (first + BAND_TILES * TILE).min(self.image.size_px()[1])]
    }

    /// Width of the picture, rounded up to whole tiles.
    #[inline(always)]
    fn padded(self) -> usize {
        self.image.tiles()[0] * TILE
    }

    /// True if the picture has row `y`.
    #[inline(always)]
    fn has_row(self, y: isize) -> bool {
        y >= 0 && y < self.image.size_px()[1] as isize
    }

    /// Notes which pixels of row `y` count.
    #[inline(always)]
    fn count(self, y: usize, line: &mut [f32]) {
        if self.is_masked {
            line.fill(1.0);
            self.target.masked_in(y, self.image.size_px()[0]).for_each(|x| line[MARGIN + x] = 0.0);
        }
    }

    /// Applies the horizontal filter to the moments of row `y`; they are zero outside the picture.
    #[inline(always)]
    fn filter_moments<L: Lanes>(self, y: isize, lines: &mut Lines) {
        let Lines { x_line, y_line, products, moments, .. } = lines;
        if !self.has_row(y) {
            (0..MOMENT_LINES).for_each(|line| moments.at_mut(line, y).fill(0.0));
            return;
        }
        let width = self.image.size_px()[0];
        read_line(self.image, self.channel, y as usize, width, x_line);
        self.target.read_line(self.channel, y as usize, width, &mut y_line[MARGIN..MARGIN + width]);
        // A masked pixel looks as the photograph does in the windows of the pixels around it.
        if self.is_masked {
            self.target.masked_in(y as usize, width).for_each(|x| y_line[MARGIN + x] = x_line[MARGIN + x]);
        }
        multiply::<L>(x_line, y_line, products);
        for x in (0..self.padded()).step_by(L::N) {
            let filtered = [
                filtered_row::<L>(x_line, x, &self.weights.window),
                filtered_row::<L>(y_line, x, &self.weights.window),
                filtered_row::<L>(products[0], x, &self.weights.window),
                filtered_row::<L>(products[1], x, &self.weights.window),
                filtered_row::<L>(products[2], x, &self.weights.window),
            ];
            for (line, value) in filtered.into_iter().enumerate() {
                value.store(&mut moments.at_mut(line, y)[x..]);
            }
        }
    }

    /// Applies the vertical filter to the moments of row `y`, then the horizontal filter to the partial derivatives.
    /// Returns the row's sum of SSIM. All are zero outside the picture.
    #[inline(always)]
    fn filter_partials<L: Lanes>(self, y: isize, lines: &mut Lines) -> f64 {
        let Lines { partial_lines, counted_line, moments, partials, .. } = lines;
        if !self.has_row(y) {
            (0..PARTIAL_LINES).for_each(|line| partials.at_mut(line, y).fill(0.0));
            return 0.0;
        }
        let window = &self.weights.window;
        self.count(y as usize, counted_line);
        let ssim = ssim_row::<L>(moments, y, self.image.size_px()[0], window, counted_line, partial_lines);
        for x in (0..self.padded()).step_by(L::N) {
            for (line, values) in partial_lines.iter().enumerate() {
                let value = filtered_row::<L>(values, x, window);
                value.store(&mut partials.at_mut(line, y)[x..]);
            }
        }
        ssim
    }

    /// Writes the gradient of row `y`. Returns all sums of the row except SSIM.
    #[inline(always)]
    fn write_gradient<L: Lanes>(self, y: usize, lines: &mut Lines, gradient: &mut [Row]) -> Sums {
        let Self { image, channel, weights, exposure, .. } = self;
        let Lines { x_line, y_line, exposed_line, counted_line, partials, .. } = lines;
        let width = image.size_px()[0];
        read_line(image, channel, y, width, x_line);
        self.target.read_line(channel, y, width, &mut y_line[MARGIN..MARGIN + width]);
        expose::<L>(x_line, exposure, width, exposed_line);
        self.count(y, counted_line);
        if self.is_masked {
            for x in self.target.masked_in(y, width) {
                (x_line[MARGIN + x], y_line[MARGIN + x], exposed_line[MARGIN + x]) = (0.0, 0.0, 0.0);
            }
        }
        let l1_slope = L::splat(weights.l1 * exposure.gain);
        let taps = partials.taps(y as isize);
        let first_tile = (y - self.rows()[0]) / TILE * image.tiles()[0];
        for tile_x in 0..image.tiles()[0] {
            let row = &mut gradient
                [(first_tile + tile_x) * image.rows_per_tile() + (RGB + channel) * TILE + y % TILE];
            for part in 0..GROUP / L::N {
                let column = tile_x * TILE + part * L::N;
                let (x, y) = (L::load(&x_line[MARGIN + column..]), L::load(&y_line[MARGIN + column..]));
                let p = each!([0, 1, 2], |line| filtered_column::<L>(&taps[line], column, &weights.window));
                let d_ssim = (x + x).mul_add(p[1], y.mul_add(p[2], p[0]));
                let sign = sign(L::load(&exposed_line[MARGIN + column..]) - y);
                let slope = d_ssim.neg_mul_add(L::splat(weights.ssim), sign * l1_slope);
                row.set(part, slope.keep(L::zero().lt(L::load(&counted_line[MARGIN + column..]))));
            }
            // Pixels beyond the right border have no gradient.
            let valid = (width - (tile_x * TILE).min(width)).min(TILE);
            row.0[valid..].fill(0.0);
        }
        differences::<L>(x_line, exposed_line, y_line)
    }
}

/// Sets the gradient of one channel to zero in the tile rows below the picture. The first `rows` rows of the band are
/// in the picture.
fn zero_below(gradient: &mut [Row], image: &TileImage, channel: usize, rows: usize) {
    let per_tile_row = image.tiles()[0] * image.rows_per_tile();
    for (tile_y, tiles) in gradient.chunks_exact_mut(per_tile_row).enumerate() {
        let valid = rows.saturating_sub(tile_y * TILE).min(TILE);
        for tile in tiles.chunks_exact_mut(image.rows_per_tile()) {
            tile[(RGB + channel) * TILE + valid..(RGB + channel + 1) * TILE].fill(Row::ZERO);
        }
    }
}

/// Copies one channel of a picture row between the margins of `line`, with zeros beyond the right border.
#[inline(always)]
fn read_line(image: &TileImage, channel: usize, y: usize, width: usize, line: &mut [f32]) {
    for tile_x in 0..image.tiles()[0] {
        let start = MARGIN + tile_x * TILE;
        line[start..start + TILE].copy_from_slice(&image.row(RGB + channel, y, tile_x).0);
    }
    line[MARGIN + width..].fill(0.0);
}

#[inline(always)]
fn multiply<L: Lanes>(x: &[f32], y: &[f32], products: &mut [&mut [f32]; 3]) {
    for start in (MARGIN..x.len() - MARGIN).step_by(L::N) {
        let (a, b) = (L::load(&x[start..]), L::load(&y[start..]));
        (a * a).store(&mut products[0][start..]);
        (b * b).store(&mut products[1][start..]);
        (a * b).store(&mut products[2][start..]);
    }
}

/// Applies the exposure to a line of the rendering. Padding is set to zero, and margins stay zero.
#[inline(always)]
fn expose<L: Lanes>(line: &[f32], exposure: Exposure, width: usize, exposed: &mut [f32]) {
    for start in (MARGIN..line.len() - MARGIN).step_by(L::N) {
        let value = L::load(&line[start..]).mul_add(L::splat(exposure.gain), L::splat(exposure.offset));
        value.store(&mut exposed[start..]);
    }
    exposed[MARGIN + width..].fill(0.0);
}

/// The sign of each lane: -1, 0 or 1.
#[inline(always)]
fn sign<L: Lanes>(value: L) -> L {
    let negative = L::splat(-1.0).keep(value.lt(L::zero()));
    L::select(L::zero().lt(value), L::splat(1.0), negative)
}

/// All sums of a line except SSIM. The padding beyond the right border is zero in all three lines, so it adds nothing.
#[inline(always)]
fn differences<L: Lanes>(x: &[f32], exposed: &[f32], y: &[f32]) -> Sums {
    let mut sums = [Total::<L>::zero(); 4];
    for group in (MARGIN..x.len() - MARGIN).step_by(GROUP) {
        for part in 0..GROUP / L::N {
            let start = group + part * L::N;
            let (x, y) = (L::load(&x[start..]), L::load(&y[start..]));
            let (raw, difference) = (x - y, L::load(&exposed[start..]) - y);
            let sign = sign(difference);
            sums[0][part] = sums[0][part] + difference.abs();
            sums[1][part] = raw.mul_add(raw, sums[1][part]);
            sums[2][part] = sums[2][part] + sign;
            sums[3][part] = sign.mul_add(x, sums[3][part]);
        }
    }
    let [l1, squares, signs, signed_x] = each!([0, 1, 2, 3], |k| f64::from(sums[k].sum()));
    Sums { l1, ssim: 0.0, squares, signs, signed_x }
}

/// Computes SSIM for each pixel of one row; it is 1 where `counted` is 0. Returns the sum, and writes the partial derivatives
/// between the margins of `partials`.
#[inline(always)]
fn ssim_row<L: Lanes>(
    moments: &Ring<'_, MOMENT_LINES>,
    y: isize,
    width: usize,
    window: &[f32; TAPS],
    counted: &[f32],
    partials: &mut [&mut [f32]; 3],
) -> f64 {
    let c = L::splat;
    let mut sum = Total::<L>::zero();
    let mut values = Row::ZERO;
    let taps = moments.taps(y);
    for group in (0..moments.width).step_by(GROUP) {
        for part in 0..GROUP / L::N {
            let start = group + part * L::N;
            let m = each!([0, 1, 2, 3, 4], |line| filtered_column::<L>(&taps[line], start, window));
            let [mu_x, mu_y, xx, yy, xy] = m;
            let (mu_xx, mu_yy, mu_xy) = (mu_x * mu_x, mu_y * mu_y, mu_x * mu_y);
            let a1 = mu_xy + mu_xy + c(C1);
            let a2 = c(2.0).mul_add(xy - mu_xy, c(C2));
            let b1 = mu_xx + mu_yy + c(C1);
            let b2 = xx - mu_xx + yy - mu_yy + c(C2);
            let inv = c(1.0) / (b1 * b2);
            let map = a1 * a2 * inv;
            let by_xx = (map / b2).neg();
            let by_xy = c(2.0) * a1 * inv;
            // The derivative with respect to μx: directly, and through σx² = E[xx] - μx² and σxy = E[xy] - μx μy.
            let by_mu = c(2.0) * (mu_y * (a2 - a1) * inv + mu_x * map * (c(1.0) / b2 - c(1.0) / b1));
            let counts = L::zero().lt(L::load(&counted[MARGIN + start..]));
            let map = L::select(counts, map, c(1.0));
            let valid = width.saturating_sub(start).min(L::N);
            let mut put = |line: usize, value: L| {
                value.keep(counts).store(&mut partials[line][MARGIN + start..]);
                partials[line][MARGIN + start + valid..MARGIN + start + L::N].fill(0.0);
            };
            put(0, by_mu);
            put(1, by_xx);
            put(2, by_xy);
            if valid == L::N {
                sum[part] = sum[part] + map;
            } else {
                values.set(0, map);
                values.0[valid..].fill(0.0);
                sum[part] = sum[part] + values.get::<L>(0);
            }
        }
    }
    f64::from(sum.sum())
}

impl TargetRgb<'_> {
    /// Writes one channel of picture row `y` to `line`. Bytes are scaled to 0..=1.
    #[inline(always)]
    fn read_line(&self, channel: usize, y: usize, width: usize, line: &mut [f32]) {
        let range = 3 * y * width..3 * (y + 1) * width;
        match self {
            Self::Bytes(rgb) => {
                for (value, pixel) in line.iter_mut().zip(rgb[range].chunks_exact(3)) {
                    *value = f32::from(pixel[channel]) * (1.0 / 255.0);
                }
            }
            Self::Floats(rgb) => {
                for (value, pixel) in line.iter_mut().zip(rgb[range].chunks_exact(3)) {
                    *value = pixel[channel];
                }
            }
        }
    }
}
