//! The pixels of a picture.

/// The colour of pixels that do not count: those that a mask or transparency hides. A picture has no other mark of them,
/// so that masks take no memory; [`crate::mask::read`] moves real pixels of this colour by one level.
pub const MASKED: [u8; 3] = [255, 0, 255];

/// An 8-bit sRGB picture without alpha.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Width and height, each at least 1.
    pub size_px: [u32; 2],
    /// `[height, width, rgb]`, flattened in that order.
    pub rgb: Vec<u8>,
}

impl Picture {
    /// Wraps `3 * width * height` bytes, `[height, width, rgb]`. Panics if `rgb` has another length.
    pub fn new(size_px: [u32; 2], rgb: Vec<u8>) -> Self {
        assert_eq!(rgb.len() as u64, bytes_of(size_px), "bytes of a {size_px:?} picture");
        Self { size_px, rgb }
    }

    /// A picture from colours between 0 and 1, `[height, width, rgb]`. They are clamped and rounded to
    /// the nearest of 256 levels; NaN becomes 0.
    pub fn from_unit(size_px: [u32; 2], rgb: &[f32]) -> Self {
        Self::new(size_px, rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect())
    }

    /// Whether each pixel counts, in the order of rows.
    pub fn counted(&self) -> impl Iterator<Item = bool> + Clone {
        self.rgb.chunks_exact(3).map(|pixel| pixel != MASKED)
    }

    /// The colours as numbers between 0 and 1, `[height, width, rgb]`.
    pub fn to_unit(&self) -> Vec<f32> {
        self.rgb.iter().map(|&v| f32::from(v) / 255.0).collect()
    }
}

/// Number of bytes in the pixels of a picture of this size.
pub(crate) fn bytes_of(size_px: [u32; 2]) -> u64 {
    3 * u64::from(size_px[0]) * u64::from(size_px[1])
}
