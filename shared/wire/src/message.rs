//! The messages and their bytes. What is decoded has been checked: a [`ModelHeader`] out of
//! [`Message::decode`] is one whose sizes agree with each other.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::body::{Bounds, CAMERA_BYTES, CameraRecord, MAX_SH_DEGREE, body_bytes_range, sh_rest};
use crate::id::{DeviceId, FrameId, ModelId, SiteId};
use crate::missing::Missing;

/// Version of the messages: the first byte of each.
pub const VERSION: u8 = 2;
/// Bytes of the CRC-32 that ends each message.
const CHECKSUM_BYTES: usize = 4;
/// Largest payload of a chunk. Brokers take 64 KiB everywhere and gain little beyond.
pub const MAX_CHUNK_BYTES: usize = 64 * 1024;
/// Largest encoding of any message but a chunk or a flight (a [`ModelHeader`]; a test holds it to that).
pub const MAX_CONTROL_BYTES: usize = 300;
/// Largest encoding of any message (a [`Chunk`]; a test holds it to that).
pub const MAX_MESSAGE_BYTES: usize = MAX_CHUNK_BYTES + 89;

/// Most cameras that a [`Flight`] tells: with them it is still a message that serial lines take.
pub const FLIGHT_CAMERAS_MAX: usize = 160;

/// Largest statement that is signed (a test holds it to that).
pub const MAX_STATEMENT_BYTES: usize = 384;
/// Begins every statement, so that a signature of something else is never one of a model.
const STATEMENT: &str = "cosurf model";

/// All that is ever said.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Message<'a> {
    /// A model is offered.
    Header(ModelHeader),
    /// A piece of a body.
    #[serde(borrow)]
    Chunk(Chunk<'a>),
    /// What the receiver has and lacks.
    Want(Want),
    /// The receiver has the whole on its disk.
    Done(Done),
    /// Birth or death of a device.
    State(State),
    /// The receiver will not take it.
    Refused(Refused),
    /// What a device has photographed.
    #[serde(borrow)]
    Flight(Flight<'a>),
}

/// Announces a model and fixes its sizes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelHeader {
    /// Who made it.
    pub device: DeviceId,
    /// Which of its models.
    pub model: ModelId,
    /// What it covers.
    pub kind: ModelKind,
    /// The world frame that its coordinates are in.
    pub frame: FrameId,
    /// How the body is laid out.
    pub codec: BodyCodec,
    /// 0 to 3.
    pub sh_degree: u8,
    /// How many splats the body has.
    pub splats: u32,
    /// How many cameras the body has.
    pub cameras: u32,
    /// How many pictures taught it.
    pub views: u32,
    /// Holds every mean.
    pub bounds: Bounds,
    /// Bytes of the whole body.
    pub body_bytes: u64,
    /// Bytes of every chunk but the last, which has the rest; 1 to [`MAX_CHUNK_BYTES`].
    pub chunk_bytes: u32,
    /// BLAKE3 of the whole body.
    pub blake3: BodyHash,
    /// Its maker's, of [`Self::statement`]; absent where nobody asks for it.
    pub signature: Option<Signature>,
}

/// An ed25519 signature.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Signature {
    /// Its first half.
    pub r: [u8; 32],
    /// Its second half.
    pub s: [u8; 32],
}

/// What a model covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ModelKind {
    /// What one device saw.
    Local,
    /// What an aggregator joined.
    Global,
    /// What one device saw, but for what it has left to others whose [`Flight`] it has heard.
    Compressed,
}

/// How a body is laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum BodyCodec {
    /// [`crate::body`]: whole numbers in packs, what stands for most first.
    Packed,
}

/// BLAKE3 of a whole body.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct BodyHash(pub [u8; 32]);

impl fmt::Display for BodyHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for BodyHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A piece of a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Chunk<'a> {
    /// Who made the model.
    pub device: DeviceId,
    /// Which of its models.
    pub model: ModelId,
    /// Which piece, from 0.
    pub index: u32,
    /// The bytes.
    pub payload: &'a [u8],
}

/// What the receiver has and lacks of a model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Want {
    /// Who made the model.
    pub device: DeviceId,
    /// Which of its models.
    pub model: ModelId,
    /// Nothing has come for a while: what is missing is not under way any more.
    pub idle: bool,
    /// What is missing.
    pub missing: Missing,
}

/// The receiver has the body on its disk: written, synced and renamed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done {
    /// Who made the model.
    pub device: DeviceId,
    /// Which of its models.
    pub model: ModelId,
    /// Hash of what is stored.
    pub blake3: BodyHash,
}

/// Birth or death of a device's session. The death is left with the broker as last will when the
/// session begins, so it carries the same number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// Whose.
    pub device: DeviceId,
    /// Number of the session, never used twice by a device: a death with an older number than the
    /// newest birth is out of date.
    pub session: u64,
    /// Birth, or death.
    pub alive: bool,
}

/// What a device has photographed: each knows what the others see before it sends a model, and can leave shared ground
/// to whom it belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Flight<'a> {
    /// Whose.
    pub device: DeviceId,
    /// The world frame of its cameras.
    pub frame: FrameId,
    /// Its cameras, [`CAMERA_BYTES`] each; of more than [`FLIGHT_CAMERAS_MAX`] as many, evenly spread.
    pub cameras: &'a [u8],
}

impl Flight<'_> {
    /// The cameras.
    pub fn records(&self) -> impl ExactSizeIterator<Item = CameraRecord> {
        self.cameras.as_chunks().0.iter().map(CameraRecord::decode)
    }

    /// Whether it holds whole cameras, not too many, that a renderer could use.
    fn is_sane(&self) -> bool {
        self.cameras.len() <= FLIGHT_CAMERAS_MAX * CAMERA_BYTES
            && self.cameras.len().is_multiple_of(CAMERA_BYTES)
            && self.records().all(|camera| camera.is_sane())
    }
}

/// The receiver will not take a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// Who made the model.
    pub device: DeviceId,
    /// Which of its models.
    pub model: ModelId,
    /// Why.
    pub reason: RefusalReason,
}

/// Why a model is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RefusalReason {
    /// The header cannot be read or contradicts itself or its topic.
    BadHeader,
    /// The body is larger than the receiver takes.
    TooLarge,
    /// The receiver is full of unfinished models: offer it again later.
    Busy,
    /// The body contradicts its header, or holds values that cannot be rendered.
    BadBody,
    /// Another body is already stored under this device and number: offer it under a new number.
    NumberTaken,
    /// The receiver could not store it: offer it again later.
    StoreFailed,
    /// Its device was withdrawn; a newer model of it is welcome.
    Withdrawn,
    /// Its coordinates are in another world frame.
    WrongFrame,
    /// The receiver has a list of keys, and none of its device.
    UnknownDevice,
    /// It is not signed, or not by its device, or has been changed since.
    BadSignature,
    /// The key that signed it counts no more.
    Revoked,
    /// A greater number of its device is stored: somebody sends an old one again.
    Replayed,
}

impl RefusalReason {
    /// Whether the same offer may succeed later.
    pub fn is_passing(self) -> bool {
        matches!(self, Self::Busy | Self::StoreFailed)
    }
}

impl fmt::Display for RefusalReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::BadHeader => "its header is malformed",
            Self::TooLarge => {
                "it is larger than the receiver takes: train with fewer splats or raise the receiver's limit"
            }
            Self::Busy => "the receiver is busy with other models",
            Self::BadBody => "its values cannot be rendered or contradict its header",
            Self::NumberTaken => "another model is stored under its number: publish it under a new number",
            Self::Withdrawn => "its device was withdrawn: a model of a later flight is welcome",
            Self::StoreFailed => "the receiver could not store it: look at the receiver's disk",
            Self::WrongFrame => "it is in another world frame: set the same `frame` on both sides",
            Self::UnknownDevice => "the receiver has no key of its device: add the device to its list",
            Self::BadSignature => {
                "it is not signed by its device: check `key` there, and the device's line in the receiver's list"
            }
            Self::Revoked => "the key that signed it is revoked: give the device a new one",
            Self::Replayed => "a greater number of its device is stored: publish it under a new number",
        })
    }
}

/// What contradicts itself in a header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum HeaderError {
    /// The degree is above 3.
    ShDegree,
    /// The size of chunks is 0 or above [`MAX_CHUNK_BYTES`], or asks for more chunks than a `u32` counts.
    ChunkBytes,
    /// `body_bytes` is less or more than the counts can make.
    BodyBytes,
    /// The bounds are not a finite box.
    Bounds,
}

/// Why bytes are no message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum WireError {
    /// No bytes at all.
    Empty,
    /// A version this build does not know.
    UnknownVersion(u8),
    /// The checksum does not fit the bytes: they have changed on their way.
    Damaged,
    /// Not the encoding of any message.
    Malformed,
    /// Bytes after the message.
    TrailingBytes,
    /// A chunk of more than [`MAX_CHUNK_BYTES`].
    ChunkTooLong,
    /// A header that contradicts itself.
    Header(HeaderError),
    /// A flight of too many cameras, or of such as cannot be.
    BadFlight,
    /// The buffer to encode into is too small.
    BufferTooSmall,
}

impl fmt::Display for WireError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Empty => write!(f, "empty message"),
            Self::UnknownVersion(found) => {
                write!(f, "message of version {found}, this build speaks {VERSION}: update the older side")
            }
            Self::Damaged => write!(f, "message damaged on its way"),
            Self::Malformed => write!(f, "malformed message"),
            Self::TrailingBytes => write!(f, "bytes after the end of a message"),
            Self::ChunkTooLong => write!(f, "chunk of more than {MAX_CHUNK_BYTES} bytes"),
            Self::BadFlight => write!(f, "flight of too many or impossible cameras"),
            Self::Header(what) => write!(f, "header with an impossible {what:?}"),
            Self::BufferTooSmall => write!(f, "no room to encode a message"),
        }
    }
}

impl core::error::Error for WireError {}

impl ModelHeader {
    /// How many chunks the body has; 0 only where [`Self::check`] fails.
    pub fn chunks(&self) -> u32 {
        if self.chunk_bytes == 0 {
            return 0;
        }
        u32::try_from(self.body_bytes.div_ceil(u64::from(self.chunk_bytes))).unwrap_or(0)
    }

    /// Where chunk `index` lies in the body, or `None` where there is no such chunk.
    pub fn chunk_range(&self, index: u32) -> Option<core::ops::Range<u64>> {
        let start = u64::from(index) * u64::from(self.chunk_bytes);
        (index < self.chunks()).then(|| start..self.body_bytes.min(start + u64::from(self.chunk_bytes)))
    }

    /// Bytes of the model once it is unpacked to `f32`, which a receiver must have room for.
    pub fn unpacked_bytes(&self) -> u64 {
        let splat = 44 + 4 * (3 + sh_rest(self.sh_degree)) as u64;
        u64::from(self.splats) * splat + u64::from(self.cameras) * CAMERA_BYTES as u64
    }

    /// What its maker signs: all that it says but for the size of chunks, which is the link's affair, and the
    /// site that it is said on.
    pub fn statement<'o>(&self, site: &SiteId, out: &'o mut [u8; MAX_STATEMENT_BYTES]) -> &'o [u8] {
        let said = Self { chunk_bytes: 0, signature: None, ..*self };
        // A test writes the longest.
        let used = postcard::to_slice(&(STATEMENT, VERSION, site, said), out).map_or(0, |used| used.len());
        &out[..used]
    }

    /// Whether the sizes agree with each other.
    pub fn check(&self) -> Result<(), HeaderError> {
        if self.sh_degree > MAX_SH_DEGREE {
            return Err(HeaderError::ShDegree);
        }
        if !body_bytes_range(self.splats, self.cameras, self.sh_degree).contains(&self.body_bytes) {
            return Err(HeaderError::BodyBytes);
        }
        if self.chunk_bytes as usize > MAX_CHUNK_BYTES || self.chunks() == 0 {
            return Err(HeaderError::ChunkBytes);
        }
        if !self.bounds.is_sane() {
            return Err(HeaderError::Bounds);
        }
        Ok(())
    }
}

impl<'a> Message<'a> {
    /// Most bytes that its encoding takes.
    pub fn bytes_max(&self) -> usize {
        MAX_CONTROL_BYTES
            + match self {
                Self::Chunk(chunk) => chunk.payload.len(),
                Self::Flight(flight) => flight.cameras.len(),
                _ => 0,
            }
    }

    /// Writes the message to the start of `out`, which [`MAX_MESSAGE_BYTES`] always fit, and
    /// [`MAX_CONTROL_BYTES`] where it is neither chunk nor flight. Returns the bytes written.
    pub fn encode<'o>(&self, out: &'o mut [u8]) -> Result<&'o [u8], WireError> {
        let (version, rest) = out.split_first_mut().ok_or(WireError::BufferTooSmall)?;
        *version = VERSION;
        let used = 1 + postcard::to_slice(self, rest).map_err(|_| WireError::BufferTooSmall)?.len();
        let (content, rest) = out.split_at_mut(used);
        let checksum = rest.first_chunk_mut().ok_or(WireError::BufferTooSmall)?;
        *checksum = crc32fast::hash(content).to_le_bytes();
        Ok(&out[..used + CHECKSUM_BYTES])
    }

    /// Reads a message; what a chunk or a flight holds stays where it is.
    pub fn decode(bytes: &'a [u8]) -> Result<Self, WireError> {
        if bytes.is_empty() {
            return Err(WireError::Empty);
        }
        let (content, checksum) = bytes.split_last_chunk::<CHECKSUM_BYTES>().ok_or(WireError::Damaged)?;
        if crc32fast::hash(content).to_le_bytes() != *checksum {
            return Err(WireError::Damaged);
        }
        let (version, content) = content.split_first().ok_or(WireError::Malformed)?;
        if *version != VERSION {
            return Err(WireError::UnknownVersion(*version));
        }
        let (message, trailing): (Self, _) =
            postcard::take_from_bytes(content).map_err(|_| WireError::Malformed)?;
        if !trailing.is_empty() {
            return Err(WireError::TrailingBytes);
        }
        match &message {
            Self::Header(header) => header.check().map_err(WireError::Header)?,
            Self::Chunk(chunk) if chunk.payload.len() > MAX_CHUNK_BYTES => {
                return Err(WireError::ChunkTooLong);
            }
            Self::Flight(flight) if !flight.is_sane() => return Err(WireError::BadFlight),
            _ => {}
        }
        Ok(message)
    }
}
