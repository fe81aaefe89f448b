//! The head and the table of a body. They tell which packs the body contains, and how large the packs are.

use core::ops::Range;

use super::basis::basis_bytes;
use super::bounds::Bounds;
use super::bytes::{Reader, Writer};
use super::camera::CAMERA_BYTES;
use super::error::BodyError;
use super::limits::{LAYOUT, MAX_SH_DEGREE, PACK_SPLATS_MAX, RATIO_MAX, sh_rest};
use super::origin::ORIGIN_BYTES;
use super::shape::{SHAPE_BYTES, SHAPE_FRAME_BYTES};

/// Size of the head in bytes.
pub const HEAD_BYTES: usize = 44;
/// Size of a table entry in bytes.
pub const PACK_ENTRY_BYTES: usize = 12;

const MAGIC: [u8; 4] = *b"CSGB";
/// Position of the checksum in the head.
const CHECKSUM_AT: usize = HEAD_BYTES - 4;
/// Flag in an entry's kind byte: the pack is stored uncompressed.
const STORED: u8 = 0x80;

/// The head: the first [`HEAD_BYTES`] of a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyHead {
    /// Number of splats.
    pub splats: u32,
    /// Number of cameras.
    pub cameras: u32,
    /// Degree of the spherical harmonics, 0 to [`MAX_SH_DEGREE`].
    pub sh_degree: u8,
    /// Number of packs.
    pub packs: u16,
    /// Box that contains the means (centres) of all splats, relative to the origin.
    pub bounds: Bounds,
}

/// The content of a pack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PackKind {
    /// All cameras.
    Cameras,
    /// Shapes of a group of splats.
    Shapes,
    /// The basis of the spherical harmonics.
    Basis,
    /// Spherical harmonics of the splats of one shapes pack.
    Sh,
    /// Differences from the shapes in a base pack to the final shapes of the same splats.
    Changes,
    /// The world position that the positions of splats and the bounds are relative to.
    Origin,
}

impl PackKind {
    /// Rank in the order of packs. Packs of lower rank come first; packs of equal rank may be mixed.
    pub(super) fn rank(self) -> u8 {
        match self {
            Self::Origin | Self::Cameras => 0,
            Self::Basis => 1,
            Self::Shapes | Self::Changes | Self::Sh => 2,
        }
    }
}

/// The encoding of a pack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PackForm {
    /// One zstd frame.
    Zstd,
    /// Uncompressed.
    Stored,
}

/// A table entry, which describes one pack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PackEntry {
    /// The pack's content.
    pub kind: PackKind,
    /// The pack's encoding.
    pub form: PackForm,
    /// Layer of the pack's splats. Layer 0 holds the most important splats, or the base.
    pub layer: u8,
    /// Number of splats; 0 for cameras, basis and origin.
    pub splats: u16,
    /// Size of the pack in the body, in bytes.
    pub bytes: u32,
    /// CRC-32 of the pack as it is stored in the body.
    pub crc32: u32,
}

impl PackEntry {
    /// Encodes the entry.
    pub fn encode(&self, out: &mut [u8; PACK_ENTRY_BYTES]) {
        let kind = self.kind as u8 | if self.form == PackForm::Stored { STORED } else { 0 };
        let mut writer = Writer(out);
        writer.bytes([kind, self.layer]);
        writer.bytes(self.splats.to_le_bytes());
        writer.bytes(self.bytes.to_le_bytes());
        writer.bytes(self.crc32.to_le_bytes());
    }

    pub(super) fn decode(bytes: &[u8; PACK_ENTRY_BYTES]) -> Option<Self> {
        let mut reader = Reader(bytes);
        let [kind, layer] = reader.bytes();
        Some(Self {
            kind: match kind & !STORED {
                0 => PackKind::Cameras,
                1 => PackKind::Shapes,
                2 => PackKind::Basis,
                3 => PackKind::Sh,
                4 => PackKind::Changes,
                5 => PackKind::Origin,
                _ => return None,
            },
            form: if kind & STORED != 0 { PackForm::Stored } else { PackForm::Zstd },
            layer,
            splats: u16::from_le_bytes(reader.bytes()),
            bytes: u32::from_le_bytes(reader.bytes()),
            crc32: u32::from_le_bytes(reader.bytes()),
        })
    }
}

impl BodyHead {
    /// Writes the encoded head to the start of `body`, which must already contain the table, since the
    /// checksum covers both.
    ///
    /// # Panics
    /// If `body` is shorter than head and table.
    pub fn encode(&self, body: &mut [u8]) {
        let mut writer = Writer(body);
        writer.bytes(MAGIC);
        writer.bytes([LAYOUT, self.sh_degree]);
        writer.bytes(self.packs.to_le_bytes());
        writer.bytes(self.splats.to_le_bytes());
        writer.bytes(self.cameras.to_le_bytes());
        writer.f32s(&self.bounds.min);
        writer.f32s(&self.bounds.max);
        let checksum = checksum(&body[..self.packs_at()]).to_le_bytes();
        body[CHECKSUM_AT..HEAD_BYTES].copy_from_slice(&checksum);
    }

    /// Position of the first pack in the body, bytes: the size of head and table.
    pub fn packs_at(&self) -> usize {
        HEAD_BYTES + usize::from(self.packs) * PACK_ENTRY_BYTES
    }

    pub(super) fn decode(body: &[u8]) -> Result<Self, BodyError> {
        let head: &[u8; HEAD_BYTES] = body.first_chunk().ok_or(BodyError::Truncated)?;
        let mut reader = Reader(head);
        if reader.bytes() != MAGIC {
            return Err(BodyError::BadMagic);
        }
        let [layout, sh_degree] = reader.bytes();
        if layout != LAYOUT {
            return Err(BodyError::UnknownLayout(layout));
        }
        let packs = u16::from_le_bytes(reader.bytes());
        let splats = u32::from_le_bytes(reader.bytes());
        let cameras = u32::from_le_bytes(reader.bytes());
        let bounds = Bounds { min: reader.f32s(), max: reader.f32s() };
        let stated = u32::from_le_bytes(reader.bytes());
        let head = Self { splats, cameras, sh_degree, packs, bounds };
        let with_table = body.get(..head.packs_at()).ok_or(BodyError::Truncated)?;
        if checksum(with_table) != stated {
            return Err(BodyError::Damaged);
        }
        if sh_degree > MAX_SH_DEGREE || !bounds.is_sane() {
            return Err(BodyError::BadHead);
        }
        Ok(head)
    }

    /// Unpacked size of a pack in bytes; for a pack of spherical harmonics, an upper bound.
    pub(super) fn unpacked_bytes(&self, entry: &PackEntry) -> usize {
        let splats = usize::from(entry.splats);
        match entry.kind {
            PackKind::Cameras => (self.cameras as usize).saturating_mul(CAMERA_BYTES),
            PackKind::Shapes => SHAPE_FRAME_BYTES + splats * SHAPE_BYTES,
            PackKind::Basis => basis_bytes(self.sh_degree),
            PackKind::Sh => splats * sh_rest(self.sh_degree),
            PackKind::Changes => splats * SHAPE_BYTES,
            PackKind::Origin => ORIGIN_BYTES,
        }
    }

    /// Whether an entry's counts and sizes are possible.
    pub(super) fn fits(&self, entry: &PackEntry) -> bool {
        let unpacked = self.unpacked_bytes(entry);
        let bytes = entry.bytes as usize;
        let has_splats = !matches!(entry.kind, PackKind::Cameras | PackKind::Basis | PackKind::Origin);
        let count_fits = match has_splats {
            true => (1..=PACK_SPLATS_MAX).contains(&usize::from(entry.splats)),
            false => entry.splats == 0,
        };
        let size_fits = match (entry.form, entry.kind) {
            // The exact unpacked size of spherical harmonics depends on the basis, which is not known here.
            (_, PackKind::Sh) => bytes <= unpacked,
            (PackForm::Stored, _) => bytes == unpacked,
            (PackForm::Zstd, _) => bytes < unpacked && unpacked <= bytes.saturating_mul(RATIO_MAX),
        };
        count_fits && size_fits
    }
}

/// Size of head and table in bytes, read from an unchecked head.
pub fn plan_bytes(head: &[u8; HEAD_BYTES]) -> usize {
    HEAD_BYTES + usize::from(u16::from_le_bytes([head[6], head[7]])) * PACK_ENTRY_BYTES
}

/// Possible sizes in bytes of a body with these numbers of splats and cameras.
pub fn body_bytes_range(splats: u32, cameras: u32, sh_degree: u8) -> Range<u64> {
    let (splats, cameras) = (u64::from(splats), u64::from(cameras));
    let stored_splats = splats * (2 * SHAPE_BYTES + sh_rest(sh_degree)) as u64;
    let least =
        HEAD_BYTES as u64 + (splats * SHAPE_BYTES as u64 + cameras * CAMERA_BYTES as u64) / RATIO_MAX as u64;
    // Worst case: each splat has its own packs.
    let table = (3 * splats + 3) * (PACK_ENTRY_BYTES + SHAPE_FRAME_BYTES) as u64;
    let most = HEAD_BYTES as u64
        + cameras * CAMERA_BYTES as u64
        + stored_splats
        + table
        + (basis_bytes(sh_degree) + ORIGIN_BYTES) as u64;
    least..most + 1
}

/// CRC-32 of the head and the table, without the field that holds the checksum.
fn checksum(with_table: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&with_table[..CHECKSUM_AT]);
    hasher.update(&with_table[HEAD_BYTES..]);
    hasher.finalize()
}
