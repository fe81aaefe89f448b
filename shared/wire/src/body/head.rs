//! Head and table of a body: what it holds and where.

use core::ops::Range;

use super::basis::basis_bytes;
use super::bytes::{Reader, Writer};
use super::{
    BodyError, Bounds, CAMERA_BYTES, MAX_SH_DEGREE, PACK_SPLATS_MAX, RATIO_MAX, SHAPE_BYTES,
    SHAPE_FRAME_BYTES, sh_rest,
};

/// Bytes of the head.
pub const HEAD_BYTES: usize = 44;
/// Bytes of an entry of the table.
pub const PACK_ENTRY_BYTES: usize = 12;
/// Version of the layout.
pub(super) const LAYOUT: u8 = 3;

const MAGIC: [u8; 4] = *b"CSGB";
/// Where the checksum stands in the head.
const CHECKSUM_AT: usize = HEAD_BYTES - 4;
/// Marks a pack that is stored as it is, in the byte of its kind.
const STORED: u8 = 0x80;

/// The first bytes of a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyHead {
    /// How many splats.
    pub splats: u32,
    /// How many cameras.
    pub cameras: u32,
    /// 0 to [`MAX_SH_DEGREE`].
    pub sh_degree: u8,
    /// How many packs.
    pub packs: u16,
    /// Holds every mean.
    pub bounds: Bounds,
}

/// What a pack holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PackKind {
    /// All cameras.
    Cameras,
    /// Shapes of some splats.
    Shapes,
    /// The basis of the spherical harmonics.
    Basis,
    /// Spherical harmonics of the splats of a pack of shapes.
    Sh,
    /// What becomes of the shapes of a pack of the base.
    Changes,
}

impl PackKind {
    /// Its place in the order of packs; equals mix.
    pub(super) fn place(self) -> u8 {
        match self {
            Self::Cameras => 0,
            Self::Basis => 1,
            Self::Shapes | Self::Changes | Self::Sh => 2,
        }
    }
}

/// How a pack is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PackForm {
    /// One frame of zstd.
    Zstd,
    /// As it is.
    Stored,
}

/// An entry of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PackEntry {
    /// What it holds.
    pub kind: PackKind,
    /// How it is written.
    pub form: PackForm,
    /// Layer of its splats, 0 for the most important, or the base.
    pub layer: u8,
    /// How many splats; 0 where it holds none.
    pub splats: u16,
    /// Bytes in the body.
    pub bytes: u32,
    /// CRC-32 of those bytes.
    pub crc32: u32,
}

impl PackEntry {
    /// Writes the entry.
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
    /// Writes the head and its checksum to the start of a body whose table, of [`Self::packs`] entries, is
    /// already in its place.
    ///
    /// # Panics
    /// Where the body is too short for that.
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

    /// Where the packs begin: bytes of head and table.
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

    /// What a pack unpacks to, bytes; of spherical harmonics the most that it may be.
    pub(super) fn unpacked_bytes(&self, entry: &PackEntry) -> usize {
        let splats = usize::from(entry.splats);
        match entry.kind {
            PackKind::Cameras => (self.cameras as usize).saturating_mul(CAMERA_BYTES),
            PackKind::Shapes => SHAPE_FRAME_BYTES + splats * SHAPE_BYTES,
            PackKind::Basis => basis_bytes(self.sh_degree),
            PackKind::Sh => splats * sh_rest(self.sh_degree),
            PackKind::Changes => splats * SHAPE_BYTES,
        }
    }

    /// Whether an entry's sizes can be.
    pub(super) fn fits(&self, entry: &PackEntry) -> bool {
        let unpacked = self.unpacked_bytes(entry);
        let bytes = entry.bytes as usize;
        let has_splats = !matches!(entry.kind, PackKind::Cameras | PackKind::Basis);
        let count_fits = match has_splats {
            true => (1..=PACK_SPLATS_MAX).contains(&usize::from(entry.splats)),
            false => entry.splats == 0,
        };
        let size_fits = match (entry.form, entry.kind) {
            // How many bytes these unpack to is known only with the basis.
            (_, PackKind::Sh) => bytes <= unpacked,
            (PackForm::Stored, _) => bytes == unpacked,
            (PackForm::Zstd, _) => bytes < unpacked && unpacked <= bytes.saturating_mul(RATIO_MAX),
        };
        count_fits && size_fits
    }
}

/// Bytes of head and table, as the first bytes of a body say before anything is checked.
pub fn plan_bytes(head: &[u8; HEAD_BYTES]) -> usize {
    HEAD_BYTES + usize::from(u16::from_le_bytes([head[6], head[7]])) * PACK_ENTRY_BYTES
}

/// How many bytes a body with these counts can have.
pub fn body_bytes_range(splats: u32, cameras: u32, sh_degree: u8) -> Range<u64> {
    let (splats, cameras) = (u64::from(splats), u64::from(cameras));
    let stored_splats = splats * (2 * SHAPE_BYTES + sh_rest(sh_degree)) as u64;
    let least =
        HEAD_BYTES as u64 + (splats * SHAPE_BYTES as u64 + cameras * CAMERA_BYTES as u64) / RATIO_MAX as u64;
    // At worst every splat has packs of its own.
    let table = (3 * splats + 2) * (PACK_ENTRY_BYTES + SHAPE_FRAME_BYTES) as u64;
    let most = HEAD_BYTES as u64
        + cameras * CAMERA_BYTES as u64
        + stored_splats
        + table
        + basis_bytes(sh_degree) as u64;
    least..most + 1
}

/// Of head and table, but for the place of the checksum itself.
fn checksum(with_table: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&with_table[..CHECKSUM_AT]);
    hasher.update(&with_table[HEAD_BYTES..]);
    hasher.finalize()
}
