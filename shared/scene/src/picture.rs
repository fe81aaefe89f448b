//! Pictures: 8-bit colour, row by row.

use std::path::Path;

use crate::SceneError;

/// An 8-bit sRGB picture without alpha.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Width and height, each at least 1.
    pub size_px: [u32; 2],
    /// `[height, width, rgb]`, flattened in that order.
    pub rgb: Vec<u8>,
}

impl Picture {
    /// Wraps bytes of the right length: `3 * width * height`.
    pub fn new(size_px: [u32; 2], rgb: Vec<u8>) -> Self {
        assert_eq!(
            rgb.len(),
            3 * size_px[0] as usize * size_px[1] as usize,
            "bytes of a {size_px:?} picture"
        );
        Self { size_px, rgb }
    }

    /// Decodes a JPEG or PNG file. Alpha is composited over black, 16 bits become 8, grey becomes colour.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let _ = path;
        unimplemented!("lands next")
    }

    /// [`Self::read`], then [`Self::resized`] where the size differs.
    pub fn read_fitted(path: &Path, size_px: [u32; 2]) -> Result<Self, SceneError> {
        let _ = (path, size_px);
        unimplemented!("lands next")
    }

    /// Width and height from the file's header, without decoding it.
    pub fn size_of(path: &Path) -> Result<[u32; 2], SceneError> {
        let _ = path;
        unimplemented!("lands next")
    }

    /// The exact area average at another size.
    pub fn resized(&self, size_px: [u32; 2]) -> Self {
        let _ = size_px;
        unimplemented!("lands next")
    }

    /// Writes a PNG file, atomically.
    pub fn write_png(&self, path: &Path) -> Result<(), SceneError> {
        let _ = path;
        unimplemented!("lands next")
    }

    /// Writes a JPEG file of `quality` 1 to 100, atomically.
    pub fn write_jpeg(&self, path: &Path, quality: u8) -> Result<(), SceneError> {
        let _ = (path, quality);
        unimplemented!("lands next")
    }

    /// The picture of colours 0 to 1, `[height, width, rgb]`; values beyond are clamped, and the
    /// rest rounded to the nearest of 256 levels.
    pub fn from_unit(size_px: [u32; 2], rgb: &[f32]) -> Self {
        Self::new(size_px, rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect())
    }

    /// Colours 0 to 1, `[height, width, rgb]`.
    pub fn to_unit(&self) -> Vec<f32> {
        self.rgb.iter().map(|&v| f32::from(v) / 255.0).collect()
    }
}
