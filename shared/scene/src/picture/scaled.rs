//! Reads a JPEG at an eighth, a quarter or a half of its size: each block of 8 × 8 pixels is transformed back at the smaller
//! size, so the large picture is never in memory.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use jpeg_decoder::{Decoder, PixelFormat};

use super::pixels::Picture;
use super::segments::Segments;
use crate::SceneError;

/// The largest of 8, 4 and 2 by which both sides of a picture can be divided so that it stays at least as wide and high as
/// `wanted_px`; 1 if there is none.
pub(super) fn divisor(size_px: [u32; 2], wanted_px: [u32; 2]) -> u32 {
    let suffices = |divisor: &u32| [0, 1].into_iter().all(|axis| size_px[axis] / divisor >= wanted_px[axis]);
    [8, 4, 2].into_iter().find(suffices).unwrap_or(1)
}

/// Width and height of a picture that is read at one part in `divisor` of its size.
pub(super) fn scaled_px(size_px: [u32; 2], divisor: u32) -> [u32; 2] {
    size_px.map(|side| side.div_ceil(divisor))
}

/// Reads the JPEG of size `whole_px` at one part in `divisor` of that. It must be grey or have three colours.
pub(super) fn read(path: &Path, whole_px: [u32; 2], divisor: u32) -> Result<Picture, SceneError> {
    let file = File::open(path).map_err(|cause| SceneError::io(path, cause))?;
    let failed = |error: jpeg_decoder::Error| {
        let error = error.to_string().replace('\n', " ");
        let reason = format!("cannot be decoded ({error}); fetch the picture again or leave it out");
        SceneError::malformed(path, reason)
    };
    let mut decoder = Decoder::new(Segments::of_pixels(BufReader::new(file)));
    let expected = scaled_px(whole_px, divisor);
    // The sides of a JPEG are numbers of 16 bits.
    let [width, height] = expected.map(|side| side.min(u32::from(u16::MAX)) as u16);
    let (width, height) = decoder.scale(width, height).map_err(failed)?;
    let size_px = [width, height].map(u32::from);
    let damaged =
        || SceneError::malformed(path, "is a damaged JPEG; fetch the picture again or leave it out");
    if size_px != expected {
        return Err(damaged());
    }
    let pixels = decoder.decode().map_err(failed)?;
    let rgb = match decoder.info().ok_or_else(damaged)?.pixel_format {
        PixelFormat::RGB24 => pixels,
        PixelFormat::L8 => pixels.into_iter().flat_map(|grey| [grey; 3]).collect(),
        _ => return Err(damaged()),
    };
    if rgb.len() as u64 != super::bytes_of(size_px) {
        return Err(damaged());
    }
    Ok(Picture::new(size_px, rgb))
}
