//! 8-bit colour pictures in memory, and their JPEG and PNG files.

mod files;
mod header;
mod resize;
#[cfg(test)]
mod tests;

use std::path::Path;

use crate::SceneError;
use header::PictureHeader;

/// An 8-bit sRGB picture without alpha.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Width and height, each at least 1.
    pub size_px: [u32; 2],
    /// `[height, width, rgb]`, flattened in that order.
    pub rgb: Vec<u8>,
}

impl Picture {
    /// Wraps `3 * width * height` bytes, `[height, width, rgb]`. Panics on any other length.
    pub fn new(size_px: [u32; 2], rgb: Vec<u8>) -> Self {
        assert_eq!(rgb.len() as u64, bytes_of(size_px), "bytes of a {size_px:?} picture");
        Self { size_px, rgb }
    }

    /// Decodes a JPEG or PNG file. Alpha is composited over black, 16 bits become 8, grey becomes
    /// colour. Orientation tags are ignored, as in COLMAP, whose cameras describe the pixels as they are
    /// stored. Errors: a file that is empty, cut short or damaged.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        files::read(path)
    }

    /// [`Self::read`], then [`Self::resized`] if the size differs.
    pub fn read_fitted(path: &Path, size_px: [u32; 2]) -> Result<Self, SceneError> {
        let picture = Self::read(path)?;
        Ok(if picture.size_px == size_px { picture } else { picture.resized(size_px) })
    }

    /// Width and height from the file's header, without decoding it.
    pub fn size_of(path: &Path) -> Result<[u32; 2], SceneError> {
        Ok(PictureHeader::read(path)?.size_px)
    }

    /// Bound on the bytes that [`Self::read_fitted`] allocates besides the picture that it returns.
    /// Computed from the file's header.
    pub fn scratch_bytes(path: &Path, size_px: [u32; 2]) -> Result<u64, SceneError> {
        Ok(PictureHeader::read(path)?.decode_bytes + resize::scratch_bytes(size_px))
    }

    /// Resamples by exact area average: shrinks without aliasing, enlarges to blocks. Computed in
    /// integers, so the bytes are the same on every machine.
    pub fn resized(&self, size_px: [u32; 2]) -> Self {
        resize::area_average(self, size_px)
    }

    /// Writes a PNG file, atomically.
    pub fn write_png(&self, path: &Path) -> Result<(), SceneError> {
        files::write_png(self, path)
    }

    /// Writes a JPEG file of `quality` 1 to 100, atomically.
    pub fn write_jpeg(&self, path: &Path, quality: u8) -> Result<(), SceneError> {
        files::write_jpeg(self, path, quality)
    }

    /// A picture from colours 0 to 1, `[height, width, rgb]`, clamped and rounded to the nearest of 256
    /// levels. NaN becomes 0.
    pub fn from_unit(size_px: [u32; 2], rgb: &[f32]) -> Self {
        Self::new(size_px, rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect())
    }

    /// Colours 0 to 1, `[height, width, rgb]`.
    pub fn to_unit(&self) -> Vec<f32> {
        self.rgb.iter().map(|&v| f32::from(v) / 255.0).collect()
    }
}

/// Bytes of the pixels of a picture.
pub(crate) fn bytes_of(size_px: [u32; 2]) -> u64 {
    3 * u64::from(size_px[0]) * u64::from(size_px[1])
}
