//! Names of sites, devices, tiles and world frames, and numbers of models. A name is checked when it is
//! made, so topics, file names and log lines can contain it without escaping.

use core::fmt;
use core::hash::{Hash, Hasher};
use core::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Maximum length of a name in bytes. A host name's label (at most 63 bytes, RFC 1035) fits.
pub const MAX_ID_BYTES: usize = 64;

/// Why a text is not a valid name or number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum IdError {
    /// The text is empty.
    Empty,
    /// The text has more than [`MAX_ID_BYTES`] bytes.
    TooLong,
    /// The text has a character outside `A-Z a-z 0-9 _ -`.
    BadCharacter(char),
    /// The text is `global`, which topics reserve for the aggregator's models.
    Reserved,
    /// A model number is not a decimal `u64` without sign or leading zeros, or the index of a chunk is not
    /// such a `u32`.
    NotANumber,
}

impl fmt::Display for IdError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Empty => write!(f, "a name must not be empty"),
            Self::TooLong => write!(f, "a name has at most {MAX_ID_BYTES} characters"),
            Self::BadCharacter(c) => write!(f, "{c:?} in a name: use only A-Z a-z 0-9 _ -"),
            Self::Reserved => write!(f, "the name `global` is reserved for the aggregator's models"),
            Self::NotANumber => write!(f, "a model number must be a plain decimal number below 2^64"),
        }
    }
}

impl core::error::Error for IdError {}

/// Up to [`MAX_ID_BYTES`] characters of `A-Z a-z 0-9 _ -`. Bytes beyond `len` are zero.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Name {
    bytes: [u8; MAX_ID_BYTES],
    len: u8,
}

impl Name {
    fn new(text: &str) -> Result<Self, IdError> {
        if text.is_empty() {
            return Err(IdError::Empty);
        }
        if text.len() > MAX_ID_BYTES {
            return Err(IdError::TooLong);
        }
        let allowed = |c: &char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
        if let Some(bad) = text.chars().find(|c| !allowed(c)) {
            return Err(IdError::BadCharacter(bad));
        }
        let mut bytes = [0; MAX_ID_BYTES];
        bytes[..text.len()].copy_from_slice(text.as_bytes());
        Ok(Self { bytes, len: text.len() as u8 })
    }

    /// Makes a name from a constant that is known to be valid.
    const fn literal(text: &str) -> Self {
        let mut bytes = [0; MAX_ID_BYTES];
        let (head, _) = bytes.split_at_mut(text.len());
        head.copy_from_slice(text.as_bytes());
        Self { bytes, len: text.len() as u8 }
    }

    fn as_str(&self) -> &str {
        // All bytes are ASCII, so this cannot fail.
        core::str::from_utf8(&self.bytes[..usize::from(self.len)]).unwrap_or_default()
    }
}

impl Hash for Name {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.as_str().hash(state);
    }
}

struct NameVisitor;

impl serde::de::Visitor<'_> for NameVisitor {
    type Value = Name;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "1 to {MAX_ID_BYTES} characters of A-Z a-z 0-9 _ -")
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Name, E> {
        Name::new(text).map_err(E::custom)
    }
}

macro_rules! define_name {
    ($name:ident, $reserved:expr, $doc:literal) => {
        #[doc = $doc]
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(Name);

        impl $name {
            /// Checks a name: 1 to [`MAX_ID_BYTES`] characters of `A-Z a-z 0-9 _ -`.
            pub fn new(text: &str) -> Result<Self, IdError> {
                if $reserved.contains(&text) {
                    return Err(IdError::Reserved);
                }
                Name::new(text).map(Self)
            }

            /// The name as text.
            pub fn as_str(&self) -> &str {
                self.0.as_str()
            }
        }

        impl FromStr for $name {
            type Err = IdError;

            fn from_str(text: &str) -> Result<Self, IdError> {
                Self::new(text)
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(self.as_str())
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{:?}", self.as_str())
            }
        }

        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.serialize_str(self.as_str())
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let name = deserializer.deserialize_str(NameVisitor)?;
                Self::new(name.as_str()).map_err(serde::de::Error::custom)
            }
        }
    };
}

define_name!(SiteId, [""; 0], "A survey site: one aggregator and its devices.");
define_name!(
    DeviceId,
    ["global"],
    "A drone or an aggregator, unique in its site. The name `global` is reserved."
);
define_name!(TileId, [""; 0], "A part of a site that has its own global model.");

define_name!(FrameId, [""; 0], "A world frame. Models in the same frame need no transform to be joined.");

impl Default for FrameId {
    /// The frame `local`, for a site that does not name its frame.
    fn default() -> Self {
        Self(Name::literal("local"))
    }
}

impl TileId {
    /// The tile that covers a whole site, for sites that are not divided into tiles.
    pub const WHOLE: Self = Self(Name::literal("whole"));
}

/// The number of a model. Each device counts its own models, and never uses the same number for different
/// bytes. The number of a global model is its revision.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ModelId(pub u64);

impl fmt::Display for ModelId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

impl FromStr for ModelId {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        parse_decimal(text).map(Self)
    }
}

impl ModelId {
    /// Smallest number of a tile of a global model. Smaller numbers are those of whole models and manifests.
    const FIRST_TILE: u64 = 1 << 63;
    /// Largest number of tiles of one revision.
    pub const TILES_MAX: usize = 1 << 16;

    /// The number of a tile that is new in a revision. `index` counts the tiles of the revision, below
    /// [`Self::TILES_MAX`].
    pub fn of_tile(revision: Self, index: usize) -> Self {
        Self(Self::FIRST_TILE | revision.0 << 16 | index as u64)
    }

    /// Whether this is the number of a tile.
    pub fn is_tile(self) -> bool {
        self.0 >= Self::FIRST_TILE
    }
}

/// Parses a decimal number, accepting only the form that `Display` writes.
pub(crate) fn parse_decimal(text: &str) -> Result<u64, IdError> {
    let canonical = text.bytes().all(|b| b.is_ascii_digit()) && (text == "0" || !text.starts_with('0'));
    if !canonical {
        return Err(IdError::NotANumber);
    }
    text.parse().map_err(|_| IdError::NotANumber)
}
