//! Masks: pictures that tell which pixels of a photograph count. White pixels count, as in COLMAP and nerfstudio.
//!
//! What it knows nothing about: losses and scores. Masked pixels have the colour [`MASKED`] in the pictures made here.

use std::path::{Path, PathBuf};

use crate::picture::{MASKED, bytes_of};
use crate::{Picture, SceneError, Shrinking};

/// Least mean of a mask or of opacity over a pixel that counts, 0 to 255. A pixel that shows even a little of what is
/// hidden must not count; masks stored as JPEG are not entirely white.
const WHITE_MIN: u8 = 243;
/// What a real pixel of the colour [`MASKED`] becomes.
const BESIDE: [u8; 3] = [254, 0, 255];

/// The mask of a photograph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// Its file.
    pub path: PathBuf,
    /// Whether black pixels count instead of white ones.
    pub is_inverted: bool,
}

/// Reads a photograph at the size `size_px`. Pixels that its mask or its transparency hides get the colour [`MASKED`]. Errors:
/// as [`Picture::read`]; a mask of another shape; no pixel is left.
pub fn read(
    path: &Path,
    mask: Option<&Mask>,
    size_px: [u32; 2],
    shrinking: Shrinking,
) -> Result<Picture, SceneError> {
    let mut picture = Picture::read_shrunk(path, size_px, shrinking)?;
    picture.rgb.chunks_exact_mut(3).filter(|pixel| *pixel == MASKED).for_each(|pixel| {
        pixel.copy_from_slice(&BESIDE);
    });
    if let Some(alpha) = Picture::read_alpha(path, size_px)? {
        hide(&mut picture, &alpha, false);
    }
    if let Some(mask) = mask {
        refuse_other_shape(path, &mask.path)?;
        hide(&mut picture, &Picture::read_fitted(&mask.path, size_px)?, mask.is_inverted);
    }
    if picture.counted().any(|counts| counts) {
        return Ok(picture);
    }
    let reason = "no pixel is left: its mask or its transparency hides all; remove the picture from the dataset, or its mask";
    Err(SceneError::malformed(path, reason))
}

/// Upper bound on the bytes that [`read`] allocates besides the picture that it returns. Reads the headers of the files.
pub fn scratch_bytes(
    path: &Path,
    mask: Option<&Mask>,
    size_px: [u32; 2],
    shrinking: Shrinking,
) -> Result<u64, SceneError> {
    let own = Picture::scratch_bytes(path, size_px, shrinking)?;
    // The opacity is decoded as the picture is without shrinking on the way, beside the picture.
    let alpha = match Picture::has_alpha(path)? {
        true => bytes_of(size_px) + Picture::scratch_bytes(path, size_px, Shrinking::AfterDecoding)?,
        false => 0,
    };
    let mask = match mask {
        Some(mask) => {
            bytes_of(size_px) + Picture::scratch_bytes(&mask.path, size_px, Shrinking::AfterDecoding)?
        }
        None => 0,
    };
    Ok(own.max(alpha).max(mask))
}

/// Of `places` in a picture of `size_px`, px from its corner: how many a mask hides, and how many lie in the picture.
pub(crate) fn hidden(mask: &Mask, size_px: [u32; 2], places: &[[f64; 2]]) -> Result<[usize; 2], SceneError> {
    let shown = Picture::read_fitted(&mask.path, size_px)?;
    let mut counts = [0; 2];
    for place in places {
        let [x, y] = place.map(|at| at.floor() as i64);
        let [width, height] = size_px.map(i64::from);
        if (0..width).contains(&x) && (0..height).contains(&y) {
            let value = shown.rgb[3 * (y * width + x) as usize];
            counts[0] += usize::from(hides(value, mask.is_inverted));
            counts[1] += 1;
        }
    }
    Ok(counts)
}

/// Whether a value of a mask or of opacity, 0 to 255, hides its pixel.
fn hides(value: u8, is_inverted: bool) -> bool {
    let white = if is_inverted { 255 - value } else { value };
    white < WHITE_MIN
}

/// Gives the pixels that `shown` hides the colour [`MASKED`]. If `is_inverted`, white hides.
fn hide(picture: &mut Picture, shown: &Picture, is_inverted: bool) {
    for (pixel, shown) in picture.rgb.chunks_exact_mut(3).zip(shown.rgb.chunks_exact(3)) {
        if hides(shown[0], is_inverted) {
            pixel.copy_from_slice(&MASKED);
        }
    }
}

/// A mask may have another size than its picture, but must have its shape.
fn refuse_other_shape(picture: &Path, mask: &Path) -> Result<(), SceneError> {
    let [[width, height], [mask_width, mask_height]] = [Picture::size_of(picture)?, Picture::size_of(mask)?];
    let [wide, high] = [f64::from(mask_width), f64::from(mask_height)];
    let ratio = f64::from(width) / f64::from(height);
    if (wide - high * ratio).abs() <= ratio.max(1.0) {
        return Ok(());
    }
    let reason = format!(
        "has {mask_width} × {mask_height} pixels, but its picture has {width} × {height}, another shape; export the masks with \
         the pictures"
    );
    Err(SceneError::malformed(mask, reason))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A picture of 8 × 4 pixels; the colour of each column is `of` its number.
    fn columns(of: fn(u8) -> [u8; 3]) -> Picture {
        Picture::new([8, 4], (0..4).flat_map(|_| (0..8).flat_map(of)).collect())
    }

    fn counted(picture: &Picture) -> Vec<bool> {
        picture.counted().take(picture.size_px[0] as usize).collect()
    }

    #[test]
    fn hidden_pixels_do_not_count_at_any_size_and_real_ones_of_that_colour_do() {
        let folder = tempfile::tempdir().unwrap();
        let [photo, path] = ["photo.png", "mask.png"].map(|name| folder.path().join(name));
        columns(|x| if x == 7 { MASKED } else { [10 * x, 100, 50] }).write_png(&photo).unwrap();
        columns(|x| [if x < 3 { 0 } else { 255 }; 3]).write_png(&path).unwrap();
        let mut mask = Mask { path: path.clone(), is_inverted: false };
        let read = |mask: &Mask, size_px| super::read(&photo, Some(mask), size_px, Shrinking::AfterDecoding);
        let whole = read(&mask, [8, 4]).unwrap();
        assert_eq!(counted(&whole), [false, false, false, true, true, true, true, true]);
        assert_eq!(whole.rgb[21..24], BESIDE);
        let half = read(&mask, [4, 2]).unwrap();
        assert_eq!(counted(&half), [false, false, true, true], "the second pixel is hidden by half");
        mask.is_inverted = true;
        assert_eq!(counted(&read(&mask, [4, 2]).unwrap()), [true, false, false, false]);
        // Of half the size, as some tools write them.
        Picture::new([4, 2], vec![255; 24]).write_png(&path).unwrap();
        let error = read(&mask, [8, 4]).unwrap_err().to_string();
        assert!(error.contains("photo.png: no pixel is left"), "{error}");
        Picture::new([4, 4], vec![255; 48]).write_png(&path).unwrap();
        let error = read(&mask, [8, 4]).unwrap_err().to_string();
        assert!(error.contains("mask.png: has 4 × 4 pixels") && error.contains("8 × 4"), "{error}");
    }

    #[test]
    fn transparent_pixels_do_not_count() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("photo.png");
        let alpha =
            image::RgbaImage::from_fn(8, 4, |x, _| image::Rgba([9, 9, 9, if x < 4 { 255 } else { 128 }]));
        alpha.save(&path).unwrap();
        for size_px in [[8, 4], [4, 2]] {
            let picture = read(&path, None, size_px, Shrinking::AfterDecoding).unwrap();
            let shown = size_px[0] as usize / 2;
            assert!(counted(&picture).into_iter().enumerate().all(|(x, counts)| counts == (x < shown)));
        }
        assert!(scratch_bytes(&path, None, [4, 2], Shrinking::AfterDecoding).unwrap() > 0);
    }
}
