//! Pictures: 8-bit colour, row by row.

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
}
