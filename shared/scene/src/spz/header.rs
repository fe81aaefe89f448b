//! What the head of an SPZ file says, and the sizes that follow from it.

use std::io::Read;

use crate::error::Refusal;
use crate::splats::sh_coefficients;

/// First bytes of a file of version 4, and of the unpacked stream of older files.
pub(super) const MAGIC: [u8; 4] = *b"NGSP";
/// Bytes that all heads begin with.
pub(super) const HEAD_BYTES: usize = 16;
/// Bits of a coordinate, which is a signed fixed-point number from version 2 on.
pub(super) const COORDINATE_BITS: u8 = 24;
/// Largest accepted ratio of uncompressed to compressed bytes; a file that claims more is refused as forged.
const RATIO_MAX: u64 = 32;

/// A version of the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Version {
    /// Positions are 16-bit floats. It was never released, and is only read.
    V1 = 1,
    /// Rotations have three bytes. Read by all viewers.
    V2 = 2,
    /// Rotations have four bytes. Read by most viewers.
    V3 = 3,
    /// Compressed with zstd instead of gzip. Read by the newest tools.
    V4 = 4,
}

/// The head of a file.
#[derive(Clone, Copy, Debug)]
pub(super) struct Header {
    pub(super) version: Version,
    pub(super) splats: usize,
    /// Degree of the harmonics in the file, 0 to 4.
    pub(super) degree_in_file: u32,
    pub(super) fraction_bits: u8,
}

impl Header {
    /// Reads the 16 bytes that the heads of all versions begin with.
    pub(super) fn read(input: &mut impl Read) -> Result<Self, Refusal> {
        let mut bytes = [0; HEAD_BYTES];
        input.read_exact(&mut bytes)?;
        if bytes[..4] != MAGIC {
            return Err("is not an SPZ file: it does not begin with NGSP".into());
        }
        let number = |at: usize| u32::from_le_bytes([0, 1, 2, 3].map(|i| bytes[at + i]));
        let version = match number(4) {
            1 => Version::V1,
            2 => Version::V2,
            3 => Version::V3,
            4 => Version::V4,
            version => {
                return Err(format!(
                    "is SPZ of version {version}; export it as version 2, 3 or 4, or as PLY"
                )
                .into());
            }
        };
        let (degree_in_file, fraction_bits) = (u32::from(bytes[12]), bytes[13]);
        if degree_in_file > 4 || fraction_bits >= COORDINATE_BITS {
            return Err("has spherical harmonics above degree 4, or coordinates without integer bits".into());
        }
        Ok(Self { version, splats: number(8) as usize, degree_in_file, fraction_bits })
    }

    /// Refuses more splats than a file of this many bytes can hold.
    pub(super) fn check_length(&self, file_bytes: u64) -> Result<(), Refusal> {
        let bytes = self.splats as u64 * self.columns().iter().sum::<usize>() as u64;
        if bytes > file_bytes.saturating_mul(RATIO_MAX) {
            return Err(format!(
                "claims {} splats, which a file of {file_bytes} bytes cannot hold; it was cut short or is forged",
                self.splats
            )
            .into());
        }
        Ok(())
    }

    /// Degree of the harmonics that are read: those above degree 3 are left out.
    pub(super) fn sh_degree(&self) -> u32 {
        self.degree_in_file.min(3)
    }

    /// Bytes of a splat in each column: positions, opacities, colours, scales, rotations and spherical harmonics.
    pub(super) fn columns(&self) -> [usize; 6] {
        let position = if self.version == Version::V1 { 6 } else { 9 };
        let quat = if self.version >= Version::V3 { 4 } else { 3 };
        [position, 1, 3, 3, quat, 3 * (sh_coefficients(self.degree_in_file) - 1)]
    }
}
