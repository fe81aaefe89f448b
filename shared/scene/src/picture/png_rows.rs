//! Reads a PNG row by row and shrinks it on the way, so that the whole picture is never in memory. The pixels are the same as
//! with the whole picture.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use image::{DynamicImage, GrayAlphaImage, GrayImage, ImageBuffer, RgbImage, RgbaImage};
use png::{BitDepth, ColorType, Decoder, DecodingError, Limits, Transformations};

use super::chunks::Chunks;
use super::header::PictureHeader;
use super::pixels::Picture;
use super::resize::AreaAverage;
use crate::SceneError;

/// Reads the picture, shrunk to `size_px`; `rgb_of` makes RGB of decoded rows. It must not be interlaced.
pub(super) fn read(
    path: &Path,
    header: &PictureHeader,
    size_px: [u32; 2],
    rgb_of: fn(DynamicImage) -> Vec<u8>,
) -> Result<Picture, SceneError> {
    let file = File::open(path).map(BufReader::new).and_then(Chunks::of_pixels);
    let file = file.map_err(|cause| SceneError::io(path, cause))?;
    let limits = Limits { bytes: usize::try_from(header.rows_bytes()).unwrap_or(usize::MAX) };
    let mut decoder = Decoder::new_with_limits(BufReader::new(file), limits);
    decoder.set_transformations(Transformations::EXPAND);
    let failed = |error: DecodingError| {
        let error = error.to_string().replace('\n', " ");
        let reason = format!("cannot be decoded ({error}); fetch the picture again or leave it out");
        SceneError::malformed(path, reason)
    };
    let mut reader = decoder.read_info().map_err(failed)?;
    let kind = reader.output_color_type();
    let mut average = AreaAverage::new(header.size_px, 1, size_px);
    // The call after the last row checks the end of the file.
    while let Some(row) = reader.next_row().map_err(failed)? {
        let whole = || SceneError::malformed(path, "has rows of several lengths; fetch the picture again");
        let row = image_of(row.data(), header.size_px[0], kind).ok_or_else(whole)?;
        average.add_row(&rgb_of(row));
    }
    Ok(average.finish())
}

/// Makes a picture, one pixel high, of a decoded row. `None` if the row's length does not fit `width`, or if its pixels are of
/// another kind than the decoder was asked for.
fn image_of(row: &[u8], width: u32, kind: (ColorType, BitDepth)) -> Option<DynamicImage> {
    use ColorType::{Grayscale, GrayscaleAlpha, Rgb, Rgba};
    let wide = || row.chunks_exact(2).map(|two| u16::from_be_bytes([two[0], two[1]])).collect::<Vec<u16>>();
    Some(match kind {
        (Grayscale, BitDepth::Eight) => GrayImage::from_raw(width, 1, row.to_vec())?.into(),
        (GrayscaleAlpha, BitDepth::Eight) => GrayAlphaImage::from_raw(width, 1, row.to_vec())?.into(),
        (Rgb, BitDepth::Eight) => RgbImage::from_raw(width, 1, row.to_vec())?.into(),
        (Rgba, BitDepth::Eight) => RgbaImage::from_raw(width, 1, row.to_vec())?.into(),
        (Grayscale, BitDepth::Sixteen) => DynamicImage::ImageLuma16(ImageBuffer::from_raw(width, 1, wide())?),
        (GrayscaleAlpha, BitDepth::Sixteen) => {
            DynamicImage::ImageLumaA16(ImageBuffer::from_raw(width, 1, wide())?)
        }
        (Rgb, BitDepth::Sixteen) => DynamicImage::ImageRgb16(ImageBuffer::from_raw(width, 1, wide())?),
        (Rgba, BitDepth::Sixteen) => DynamicImage::ImageRgba16(ImageBuffer::from_raw(width, 1, wide())?),
        _ => return None,
    })
}
