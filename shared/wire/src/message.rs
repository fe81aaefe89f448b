//! The messages and their encoding. [`Message::decode`] returns only valid messages: for example, the sizes
//! in a decoded [`ModelHeader`] agree with each other.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::body::{Bounds, CAMERA_BYTES, MAX_SH_DEGREE, body_bytes_range, sh_rest};
use crate::flight::{ConfirmedFlights, FlightCameras, FlightPledge};
use crate::hash::BodyHash;
use crate::id::{DeviceId, FrameId, ModelId};
use crate::missing::Missing;
use crate::plan::Plan;

/// Version of the message format: the first byte of every message.
pub const VERSION: u8 = 3;
/// The version before. Its headers are those of this version, followed by a signature.
pub(crate) const VERSION_BEFORE: u8 = 2;
/// Bytes of the CRC-32 at the end of every message.
pub(crate) const CHECKSUM_BYTES: usize = 4;
/// Largest payload of a chunk, bytes. Common brokers accept messages of this size, and larger chunks would
/// gain little.
pub const MAX_CHUNK_BYTES: usize = 64 * 1024;
/// Smallest size of the chunks of a body that has more than one, bytes. With smaller ones, a receiver would do much work for
/// few bytes.
pub const MIN_CHUNK_BYTES: u32 = 256;
/// Largest number of chunks of a body. It bounds the work for a [`Want`].
pub const MAX_CHUNKS: u32 = 1 << 16;
/// Size in bytes of the largest encoding of a message with its seal, except [`Message::Chunk`], [`Message::Flight`],
/// [`Message::ConfirmedFlights`] and [`Message::Plan`]. A test checks it.
pub const MAX_CONTROL_BYTES: usize = 384;
/// Size in bytes of the largest encoding of a [`Chunk`]. No other message is larger. A test checks it.
pub const MAX_MESSAGE_BYTES: usize = MAX_CHUNK_BYTES + 89;

/// Largest number of cameras of a model: more than any site has pictures.
pub const CAMERAS_MAX: u32 = 1 << 16;
/// Largest body of a manifest, bytes: about 200,000 tiles.
const MANIFEST_BYTES_MAX: u64 = 16 << 20;
/// A manifest takes at most so many times as much memory as its body.
const MANIFEST_GROWTH: u64 = 128;

/// Any message of the protocol.
///
/// # Examples
///
/// ```
/// use cosurf_wire::{DeviceId, MAX_CONTROL_BYTES, Message, State, WireError};
///
/// let device = DeviceId::new("drone-1")?;
/// let message = Message::State(State { device, session: 1, alive: true });
/// let mut buffer = [0; MAX_CONTROL_BYTES];
/// let bytes = message.encode(&mut buffer)?;
/// assert_eq!(Message::decode(bytes)?, message);
///
/// // The checksum detects damage in transit.
/// let mut damaged = bytes.to_vec();
/// damaged[3] ^= 1;
/// assert_eq!(Message::decode(&damaged), Err(WireError::Damaged));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Message<'a> {
    /// A sender offers a model.
    Header(ModelHeader),
    /// A part of a body.
    #[serde(borrow)]
    Chunk(Chunk<'a>),
    /// The chunks that the receiver has and lacks.
    Want(Want),
    /// The receiver has stored the whole body on disk.
    Done(Done),
    /// Start or end of a device's session.
    State(State),
    /// The receiver refuses a model.
    Refused(Refused),
    /// The cameras of a device's flight.
    #[serde(borrow)]
    Flight(FlightCameras<'a>),
    /// A device's pledge to send a model of its flight.
    FlightPledge(FlightPledge),
    /// The flights that the aggregator has confirmed.
    #[serde(borrow)]
    ConfirmedFlights(ConfirmedFlights<'a>),
    /// A device's cell of the site's plan.
    #[serde(borrow)]
    Plan(Plan<'a>),
}

/// Announces a model and its sizes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelHeader {
    /// The device that made the model.
    pub device: DeviceId,
    /// Number of the model, counted by the device that made it.
    pub model: ModelId,
    /// Local, global or compressed.
    pub kind: ModelKind,
    /// The world frame of the model's coordinates.
    pub frame: FrameId,
    /// The layout of the body, and whether its coordinates have a place in the world.
    pub codec: BodyCodec,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    /// Number of splats in the body.
    pub splats: u32,
    /// Number of cameras in the body.
    pub cameras: u32,
    /// Number of pictures that the model was trained on.
    pub views: u32,
    /// Box that contains the means (centres) of all splats, relative to the body's origin.
    pub bounds: Bounds,
    /// Size of the whole body in bytes.
    pub body_bytes: u64,
    /// Size in bytes of every chunk except the last, at most [`MAX_CHUNK_BYTES`] and, if there are several chunks, at
    /// least [`MIN_CHUNK_BYTES`]. The last chunk has the remaining bytes.
    pub chunk_bytes: u32,
    /// BLAKE3 hash of the whole body.
    pub blake3: BodyHash,
}

/// Who made a model, and which part of the scene it contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ModelKind {
    /// Trained by a device: everything that the device observed.
    Local,
    /// Merged by an aggregator from several models.
    Global,
    /// A local model that was pruned before upload: where several devices observe the same ground, it lacks
    /// the splats that another device owns. The device computes the owners from the cameras that all devices
    /// announce ([`FlightCameras`]).
    Compressed,
    /// The list of the tiles of a global model that is too large to be sent whole. Its number is the model's
    /// revision, and its body lists the tiles and who gets which. A tile is a [`ModelKind::Global`] of its own.
    Manifest,
}

/// The layout of a body, and whether its coordinates have a place in the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum BodyCodec {
    /// [`crate::body`]: quantised to integers, in independently decodable packs, most important first.
    Packed,
    /// As [`Self::Packed`]; and neither GPS nor control points tell where the model lies, so its coordinates are in a frame of
    /// its own. Programs of version 0.1 do not know it, and send all models as [`Self::Packed`].
    PackedUnplaced,
}

/// A part of a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Chunk<'a> {
    /// The device that made the model.
    pub device: DeviceId,
    /// Number of the model, counted by the device that made it.
    pub model: ModelId,
    /// Index of the chunk, from 0. The chunk starts at byte `index * chunk_bytes` of the body.
    pub index: u32,
    /// The bytes of the body that belong to this chunk.
    pub payload: &'a [u8],
}

/// Tells the sender which chunks of a model the receiver has and lacks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Want {
    /// The device that made the model.
    pub device: DeviceId,
    /// Number of the model, counted by the device that made it.
    pub model: ModelId,
    /// Session of the sender whose offer this message answers, from the seal of the header; 0 if the header has no seal.
    pub session: u64,
    /// No chunk has arrived for a while: the sender must treat the missing chunks as lost.
    pub idle: bool,
    /// The missing chunks.
    pub missing: Missing,
}

/// The receiver has stored the body on disk: written, synced and renamed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done {
    /// The device that made the model.
    pub device: DeviceId,
    /// Number of the model, counted by the device that made it.
    pub model: ModelId,
    /// Session of the sender whose offer this message answers, from the seal of the header; 0 if the header has no seal.
    pub session: u64,
    /// Hash of the stored body.
    pub blake3: BodyHash,
}

/// Start or end of a device's session. When the session starts, the device registers the end message as its
/// last will, which the broker publishes when the connection breaks. Both messages have the same session
/// number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// The device that sends the message.
    pub device: DeviceId,
    /// Number of the session, higher than those of the device's earlier sessions. Receivers ignore the end
    /// of a session if a newer session of the device has started.
    pub session: u64,
    /// `true` at the start of the session, `false` at its end.
    pub alive: bool,
}

/// The receiver refuses a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// The device that made the model.
    pub device: DeviceId,
    /// Number of the model, counted by the device that made it.
    pub model: ModelId,
    /// Session of the sender whose offer this message answers, from the seal of the header; 0 if the header has no seal.
    pub session: u64,
    /// Why the model is refused.
    pub reason: RefusalReason,
}

/// Why a receiver refuses a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RefusalReason {
    /// The body is larger than the receiver accepts.
    TooLarge,
    /// The receiver has no room for another unfinished model. The sender should offer the model again
    /// later.
    Busy,
    /// The body contradicts its header, or holds values that cannot be rendered.
    BadBody,
    /// Another body is already stored under this device and number. The sender should offer the model under
    /// a new number.
    NumberTaken,
    /// The receiver could not write the model to disk. The sender should offer the model again later.
    StoreFailed,
    /// An operator withdrew the device's models. The receiver still accepts newer models of the device.
    Withdrawn,
    /// The model's world frame is not that of the receiver.
    WrongFrame,
    /// The receiver has stored a model of the same device with a higher number, so this model is treated as
    /// a replay.
    Replayed,
    /// The chunks that arrived do not have the hash that the header announced, several times in a row. The sender should
    /// offer the model again later.
    Garbled,
    /// The receiver keeps models of as many devices as it may.
    TooManyDevices,
}

impl RefusalReason {
    /// Whether the same offer may succeed later.
    pub fn is_temporary(self) -> bool {
        matches!(self, Self::Busy | Self::StoreFailed | Self::Garbled)
    }
}

impl fmt::Display for RefusalReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::TooLarge => {
                "it is larger than the receiver accepts: train with fewer splats or raise the receiver's limit"
            }
            Self::Busy => "the receiver is busy with other models",
            Self::BadBody => "its values cannot be rendered or contradict its header",
            Self::NumberTaken => "another model of this device is stored under its number",
            Self::Withdrawn => "its device was withdrawn: publish a model of a later flight",
            Self::StoreFailed => "the receiver could not store it: check the receiver's disk",
            Self::WrongFrame => "it is in another world frame: set the same `frame` on both sides",
            Self::Replayed => "a model of this device with a higher number is stored",
            Self::Garbled => {
                "its chunks were changed on the way: check whether another participant writes to its topics"
            }
            Self::TooManyDevices => "the receiver has models of as many devices as it may: raise `devices_max` there",
        })
    }
}

/// Which field of a header is invalid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum HeaderError {
    /// The degree of the spherical harmonics is above 3.
    ShDegree,
    /// The chunk size is 0, above [`MAX_CHUNK_BYTES`], below [`MIN_CHUNK_BYTES`] though there are several chunks, or so
    /// small that there are more than [`MAX_CHUNKS`].
    ChunkBytes,
    /// There are more than [`CAMERAS_MAX`] cameras.
    Cameras,
    /// A body with the header's numbers of splats and cameras cannot have `body_bytes` bytes.
    BodyBytes,
    /// The bounds are not finite, or a minimum is above its maximum.
    Bounds,
}

/// Why bytes are not a valid message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum WireError {
    /// There are no bytes.
    Empty,
    /// This build does not know the message's version.
    UnknownVersion(u8),
    /// The checksum does not match: the bytes were changed in transit.
    Damaged,
    /// The bytes do not encode any message.
    Malformed,
    /// Bytes follow the message.
    TrailingBytes,
    /// The chunk has more than [`MAX_CHUNK_BYTES`] bytes.
    ChunkTooLong,
    /// The header contradicts itself.
    Header(HeaderError),
    /// The flight has too many cameras, or invalid cameras; or the list of flights contradicts itself.
    BadFlight,
    /// The cell of a plan has too many, too few or invalid corners, or its margin is no share.
    BadPlan,
    /// The output buffer is too small.
    BufferTooSmall,
}

impl fmt::Display for WireError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Empty => write!(f, "empty message"),
            Self::UnknownVersion(found) => {
                write!(f, "message of version {found}, this build uses {VERSION}: update the older side")
            }
            Self::Damaged => write!(f, "message damaged in transit"),
            Self::Malformed => write!(f, "malformed message"),
            Self::TrailingBytes => write!(f, "bytes after the end of a message"),
            Self::ChunkTooLong => write!(f, "chunk of more than {MAX_CHUNK_BYTES} bytes"),
            Self::BadFlight => write!(
                f,
                "flight with too many or invalid cameras, or a list of flights that contradicts itself"
            ),
            Self::BadPlan => {
                write!(f, "plan whose cell is no polygon of finite corners, or whose margin is no share")
            }
            Self::Header(what) => write!(f, "header with an invalid {what:?}"),
            Self::BufferTooSmall => write!(f, "buffer too small to encode a message"),
        }
    }
}

impl core::error::Error for WireError {}

impl ModelHeader {
    /// Whether the model lies in the world frame, as far as its device knows.
    pub fn is_placed(&self) -> bool {
        self.codec != BodyCodec::PackedUnplaced
    }

    /// Number of chunks of the body. It is 0 only if [`Self::check`] fails.
    pub fn chunks(&self) -> u32 {
        if self.chunk_bytes == 0 {
            return 0;
        }
        u32::try_from(self.body_bytes.div_ceil(u64::from(self.chunk_bytes))).unwrap_or(0)
    }

    /// Byte range of chunk `index` in the body; `None` if there is no such chunk.
    pub fn chunk_range(&self, index: u32) -> Option<core::ops::Range<u64>> {
        let start = u64::from(index) * u64::from(self.chunk_bytes);
        (index < self.chunks()).then(|| start..self.body_bytes.min(start + u64::from(self.chunk_bytes)))
    }

    /// Memory that a receiver needs for the model, bytes, when its splats are unpacked to `f32`, or for the list of a
    /// manifest.
    pub fn unpacked_bytes(&self) -> u64 {
        if self.kind == ModelKind::Manifest {
            return MANIFEST_GROWTH * self.body_bytes;
        }
        let splat = 44 + 4 * (3 + sh_rest(self.sh_degree)) as u64;
        u64::from(self.splats) * splat + u64::from(self.cameras) * CAMERA_BYTES as u64
    }

    /// Checks that the fields agree with each other.
    pub fn check(&self) -> Result<(), HeaderError> {
        if self.sh_degree > MAX_SH_DEGREE {
            return Err(HeaderError::ShDegree);
        }
        if self.cameras > CAMERAS_MAX {
            return Err(HeaderError::Cameras);
        }
        let body_bytes = match self.kind {
            ModelKind::Manifest => 1..MANIFEST_BYTES_MAX + 1,
            _ => body_bytes_range(self.splats, self.cameras, self.sh_degree),
        };
        if !body_bytes.contains(&self.body_bytes) {
            return Err(HeaderError::BodyBytes);
        }
        let is_small = self.chunk_bytes < MIN_CHUNK_BYTES && self.chunks() > 1;
        if self.chunk_bytes as usize > MAX_CHUNK_BYTES
            || is_small
            || !(1..=MAX_CHUNKS).contains(&self.chunks())
        {
            return Err(HeaderError::ChunkBytes);
        }
        if !self.bounds.is_sane() {
            return Err(HeaderError::Bounds);
        }
        Ok(())
    }
}

impl<'a> Message<'a> {
    /// Upper bound on the size of the encoding in bytes, with a seal.
    pub fn bytes_max(&self) -> usize {
        MAX_CONTROL_BYTES
            + match self {
                Self::Chunk(chunk) => chunk.payload.len(),
                Self::Flight(flight) => flight.cameras.len(),
                Self::ConfirmedFlights(list) => list.flights.len(),
                Self::Plan(plan) => plan.cell.len(),
                _ => 0,
            }
    }

    /// Writes the encoded message to the start of `out`, and returns the written bytes.
    /// [`MAX_MESSAGE_BYTES`] are enough for every message; [`MAX_CONTROL_BYTES`] are enough for all except
    /// chunks, flights, lists of flights and plans.
    pub fn encode<'o>(&self, out: &'o mut [u8]) -> Result<&'o [u8], WireError> {
        let (version, rest) = out.split_first_mut().ok_or(WireError::BufferTooSmall)?;
        *version = VERSION;
        let used = 1 + postcard::to_slice(self, rest).map_err(|_| WireError::BufferTooSmall)?.len();
        let (content, rest) = out.split_at_mut(used);
        let checksum = rest.first_chunk_mut().ok_or(WireError::BufferTooSmall)?;
        *checksum = crc32fast::hash(content).to_le_bytes();
        Ok(&out[..used + CHECKSUM_BYTES])
    }

    /// The version and the content of an encoded message, without its checksum, which is checked. The version is ours.
    pub(crate) fn content(bytes: &'a [u8]) -> Result<&'a [u8], WireError> {
        if bytes.is_empty() {
            return Err(WireError::Empty);
        }
        let (content, checksum) = bytes.split_last_chunk::<CHECKSUM_BYTES>().ok_or(WireError::Damaged)?;
        if crc32fast::hash(content).to_le_bytes() != *checksum {
            return Err(WireError::Damaged);
        }
        match content.first() {
            None => Err(WireError::Malformed),
            Some(&VERSION) => Ok(content),
            Some(&version) => Err(WireError::UnknownVersion(version)),
        }
    }

    /// Decodes and checks the message at the start of `content`, behind the version byte. Also returns the bytes after it.
    pub(crate) fn take(content: &'a [u8]) -> Result<(Self, &'a [u8]), WireError> {
        let content = content.get(1..).ok_or(WireError::Malformed)?;
        let (message, rest): (Self, _) =
            postcard::take_from_bytes(content).map_err(|_| WireError::Malformed)?;
        match &message {
            Self::Header(header) => header.check().map_err(WireError::Header)?,
            Self::Chunk(chunk) if chunk.payload.len() > MAX_CHUNK_BYTES => {
                return Err(WireError::ChunkTooLong);
            }
            Self::Flight(flight) if !flight.is_sane() => return Err(WireError::BadFlight),
            Self::ConfirmedFlights(list) if !list.is_sane() => return Err(WireError::BadFlight),
            Self::Plan(plan) if !plan.is_sane() => return Err(WireError::BadPlan),
            _ => {}
        }
        Ok((message, rest))
    }
}

/// Size in bytes of the largest [`refusal_for_version_before`].
pub const REFUSAL_BEFORE_BYTES: usize = 1 + 1 + 65 + 10 + 1 + CHECKSUM_BYTES;

/// Encodes the refusal of a model for a device that speaks the version before: its header is malformed. Devices of this
/// version do not read it. Returns the written bytes.
pub fn refusal_for_version_before(
    device: DeviceId,
    model: ModelId,
    out: &mut [u8; REFUSAL_BEFORE_BYTES],
) -> &[u8] {
    /// Index of `Refused` among the messages of that version.
    const REFUSED: u8 = 5;
    /// Index of `BadHeader` among its reasons.
    const BAD_HEADER: u8 = 0;
    // Cannot fail: a test encodes the longest refusal.
    let used = postcard::to_slice(&(VERSION_BEFORE, REFUSED, device, model, BAD_HEADER), out)
        .map_or(0, |used| used.len());
    let checksum = crc32fast::hash(&out[..used]).to_le_bytes();
    out[used..used + CHECKSUM_BYTES].copy_from_slice(&checksum);
    &out[..used + CHECKSUM_BYTES]
}
