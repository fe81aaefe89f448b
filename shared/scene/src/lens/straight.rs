//! Pictures without the distortion of their lens, for lenses that COLMAP does not know.

use glam::DVec2;
use rayon::prelude::*;

use super::brown::FullBrown;
use super::{Distortion, Lens};
use crate::Picture;
use crate::error::Refusal;
use crate::picture::bytes_of;

/// Steps along each border and across the picture in which the model is looked at.
const STEPS: u32 = 64;
/// Most times that a picture without distortion is as wide or high as the picture itself.
const GROWTH_MAX: f64 = 4.0;
/// The refusal of a model that shows two directions in one place.
const FOLDS: &str = "its distortion folds the picture over; let the program that found the poses optimise the cameras with fewer coefficients";

impl Lens {
    /// The pinhole that shows the largest upright rectangle of what this lens shows, with the same focal lengths.
    pub(crate) fn straight(&self) -> Result<Self, Refusal> {
        let Distortion::FullBrown(brown) = &self.distortion else { return Ok(*self) };
        let [width, height] = self.size_px.map(f64::from);
        let ray = |x: f64, y: f64| {
            let shown = (DVec2::new(x * width, y * height) - self.center_px) / self.focal_px;
            brown.ray(shown).ok_or(FOLDS)
        };
        let (mut from, mut to) = (DVec2::NEG_INFINITY, DVec2::INFINITY);
        for along in shares() {
            from = from.max(DVec2::new(ray(0.0, along)?.x, ray(along, 0.0)?.y));
            to = to.min(DVec2::new(ray(1.0, along)?.x, ray(along, 1.0)?.y));
        }
        let is_open = |ray: DVec2| brown.distort(ray).1.determinant() > 0.0;
        if !shares().all(|x| shares().all(|y| is_open(from + (to - from) * DVec2::new(x, y)))) {
            return Err(FOLDS.into());
        }
        let size = ((to - from) * self.focal_px).floor();
        if !(size.min_element() >= 1.0 && (size / DVec2::new(width, height)).max_element() <= GROWTH_MAX) {
            return Err("its distortion leaves no upright picture".into());
        }
        let size_px = size.to_array().map(|side| side as u32);
        Self { center_px: -from * self.focal_px, size_px, distortion: Distortion::NONE, ..*self }.checked()
    }

    /// What `straight`, the pinhole of [`Self::straight`], shows of a picture of this lens, with bilinear interpolation, as
    /// COLMAP's undistorter has it.
    pub(crate) fn straightened(&self, picture: &Picture, straight: &Self) -> Picture {
        let Distortion::FullBrown(brown) = &self.distortion else { return picture.clone() };
        let mut rgb = vec![0; bytes_of(straight.size_px) as usize];
        let rows = rgb.par_chunks_exact_mut(3 * straight.size_px[0] as usize);
        rows.enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let at_px = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                pixel.copy_from_slice(&sample(picture, self.shown(brown, straight, at_px)));
            }
        });
        Picture::new(straight.size_px, rgb)
    }

    /// Where this lens shows what a pinhole shows at a position.
    fn shown(&self, brown: &FullBrown, pinhole: &Self, at_px: DVec2) -> DVec2 {
        let ray = (at_px - pinhole.center_px) / pinhole.focal_px;
        brown.distort(ray).0 * self.focal_px + self.center_px
    }
}

/// Numbers from 0 to 1 at even steps.
fn shares() -> impl Iterator<Item = f64> {
    (0..=STEPS).map(|step| f64::from(step) / f64::from(STEPS))
}

/// The colour at a position, between the centres of four pixels; beyond the border that of the border.
fn sample(picture: &Picture, at_px: DVec2) -> [u8; 3] {
    let last = picture.size_px.map(|side| f64::from(side - 1));
    let at = (at_px - 0.5).clamp(DVec2::ZERO, DVec2::from(last));
    let (floor, part) = (at.floor(), at.fract());
    let color = |x: f64, y: f64| {
        let (x, y) = (x.min(last[0]) as usize, y.min(last[1]) as usize);
        let begin = 3 * (y * picture.size_px[0] as usize + x);
        [0, 1, 2].map(|channel| f64::from(picture.rgb[begin + channel]))
    };
    let (a, b) = (color(floor.x, floor.y), color(floor.x + 1.0, floor.y));
    let (c, d) = (color(floor.x, floor.y + 1.0), color(floor.x + 1.0, floor.y + 1.0));
    let mix = |a: f64, b: f64, share: f64| a + (b - a) * share;
    [0, 1, 2].map(|i| (mix(mix(a[i], b[i], part.x), mix(c[i], d[i], part.x), part.y) + 0.5) as u8)
}

#[cfg(test)]
mod tests;
