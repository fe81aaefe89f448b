//! When a picture is shrunk.

/// When a picture is shrunk. PNGs, unless they are interlaced, are always shrunk row by row while they are decoded, to the
/// same pixels as after it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shrinking {
    /// After it is decoded: each new pixel is the exact mean of its area.
    #[default]
    AfterDecoding,
    /// A JPEG is decoded at a half, a quarter or an eighth of its size if that is large enough, and then shrunk. This takes
    /// far less memory. Its pixels differ from the exact ones by about one of 255 levels. A progressive JPEG, whose pixels are
    /// spread over the file, is decoded whole all the same.
    WhileDecoding,
}
