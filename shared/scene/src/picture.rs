//! 8-bit colour pictures in memory, and their files.

mod chunks;
mod files;
mod header;
mod pixels;
mod png_rows;
mod resize;
mod rgb;
mod scaled;
mod segments;
mod shrinking;
#[cfg(test)]
mod tests;

use std::path::Path;

use crate::SceneError;
use header::PictureHeader;
pub(crate) use pixels::bytes_of;
pub use pixels::{MASKED, Picture};
pub use shrinking::Shrinking;

impl Picture {
    /// Decodes a JPEG, PNG, WebP, TIFF or BMP file. Alpha is composited over black, channels of 16 bits are reduced to 8,
    /// and grey becomes RGB. Orientation tags are ignored, as in COLMAP, whose cameras describe the
    /// pixels as they are stored. Errors: a file that is empty, cut short or damaged.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        files::read(path)
    }

    /// Like [`Self::read`], then [`Self::resized`] if the picture's size is not `size_px`.
    pub fn read_fitted(path: &Path, size_px: [u32; 2]) -> Result<Self, SceneError> {
        Self::read_shrunk(path, size_px, Shrinking::AfterDecoding)
    }

    /// As [`Self::read_fitted`], with a choice of when the picture is shrunk.
    pub fn read_shrunk(path: &Path, size_px: [u32; 2], shrinking: Shrinking) -> Result<Self, SceneError> {
        files::read_fitted(path, size_px, shrinking)
    }

    /// The opacity of each pixel as a grey picture, white where nothing shows through, resampled to `size_px`; `None` if the
    /// file has no transparency.
    pub fn read_alpha(path: &Path, size_px: [u32; 2]) -> Result<Option<Self>, SceneError> {
        files::read_alpha(path, size_px)
    }

    /// Whether the file's header tells of transparency; the pixels are not decoded.
    pub(crate) fn has_alpha(path: &Path) -> Result<bool, SceneError> {
        Ok(PictureHeader::read(path)?.has_alpha)
    }

    /// Width and height from the file's header; the pixels are not decoded.
    pub fn size_of(path: &Path) -> Result<[u32; 2], SceneError> {
        Ok(PictureHeader::read(path)?.size_px)
    }

    /// The EXIF orientation, 1 to 8; `None` if the file cannot be read. 1 and missing tags mean that the rows are stored as
    /// they are shown.
    pub fn orientation(path: &Path) -> Option<u8> {
        files::orientation(path)
    }

    /// As [`Self::size_of`], with an error if the file was cut short. The pixels are not decoded.
    pub fn size_of_whole(path: &Path) -> Result<[u32; 2], SceneError> {
        files::size_of_whole(path)
    }

    /// Upper bound on the bytes that [`Self::read_shrunk`] allocates besides the picture that it
    /// returns. Computed from the file's header.
    pub fn scratch_bytes(path: &Path, size_px: [u32; 2], shrinking: Shrinking) -> Result<u64, SceneError> {
        Ok(PictureHeader::read(path)?.scratch_bytes(size_px, shrinking) + resize::scratch_bytes(size_px))
    }

    /// Resamples the picture: each new pixel is the exact mean of the area that it covers. Shrinking
    /// causes little aliasing; enlarging shows the old pixels as blocks. Computed in integers, so the bytes
    /// are the same on every machine.
    pub fn resized(&self, size_px: [u32; 2]) -> Self {
        resize::area_average(self, size_px)
    }

    /// Writes a PNG file, atomically.
    pub fn write_png(&self, path: &Path) -> Result<(), SceneError> {
        files::write_png(self, path)
    }

    /// Writes a JPEG file of `quality` 1 to 100, atomically.
    pub fn write_jpeg(&self, path: &Path, quality: u8) -> Result<(), SceneError> {
        files::write_jpeg(self, path, quality, Vec::new())
    }

    /// As [`Self::write_jpeg`], with EXIF data, in the format of TIFF, as cameras write them.
    pub fn write_photograph(&self, path: &Path, quality: u8, exif: Vec<u8>) -> Result<(), SceneError> {
        files::write_jpeg(self, path, quality, exif)
    }
}
