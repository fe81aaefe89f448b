//! Why bytes are not a valid body.

use core::fmt;

use super::limits::LAYOUT;

/// Why bytes are not a valid body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BodyError {
    /// The body is shorter than its head and table.
    Truncated,
    /// The body does not begin with `CSGB`.
    BadMagic,
    /// This build does not know the body's layout.
    UnknownLayout(u8),
    /// The degree of the spherical harmonics is above [`crate::body::MAX_SH_DEGREE`], or the bounds are
    /// invalid.
    BadHead,
    /// The head or the table does not match the checksum.
    Damaged,
    /// A table entry contradicts the head, is out of order, or has impossible sizes.
    BadTable,
    /// The body does not have the size that the table requires.
    WrongSize {
        /// Size of the body according to its head and table, in bytes.
        expected: u64,
        /// Actual size in bytes.
        found: u64,
    },
    /// A pack cannot be unpacked, or holds invalid values.
    BadPack,
}

impl fmt::Display for BodyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated => write!(f, "body is shorter than its head and table"),
            Self::BadMagic => write!(f, "body does not begin with CSGB"),
            Self::UnknownLayout(found) => {
                write!(f, "body layout {found} is not {}: update the older side", LAYOUT)
            }
            Self::BadHead => write!(f, "body head has invalid values"),
            Self::Damaged => write!(f, "body head or table is damaged"),
            Self::BadTable => write!(f, "body table contradicts itself"),
            Self::WrongSize { expected, found } => {
                write!(f, "body has {found} bytes, but its table requires {expected}")
            }
            Self::BadPack => write!(f, "body pack cannot be unpacked"),
        }
    }
}

impl core::error::Error for BodyError {}
