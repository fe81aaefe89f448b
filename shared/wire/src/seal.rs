//! Seals: who sent a message, in which session, as which message of the session, and the sender's signature of all that.
//!
//! A sealed message is encoded as the message without its checksum, then the seal (sender, session, count and the 64
//! bytes of the signature), then the checksum. Chunks are never sealed: the header has the hash of the body. So 80 to
//! 149 bytes are added to the small messages only.
//!
//! The signature covers [`statement`]: a prefix, the topic with the site, and all bytes before the signature.

use serde::{Deserialize, Serialize};

use crate::id::DeviceId;
use crate::message::{CHECKSUM_BYTES, Message, VERSION_BEFORE, WireError};

/// Size in bytes of the largest seal. A test checks it.
pub const MAX_SEAL_BYTES: usize = 149;
/// Bytes of a signature.
const SIGNATURE_BYTES: usize = 64;
/// Prefix of every [`statement`], so that a signature of other data is never valid for a message.
const STATEMENT: &[u8] = b"cosurf message\0";

/// An ed25519 signature.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Signature {
    /// First half of the signature: the point R.
    pub r: [u8; 32],
    /// Second half of the signature: the scalar s.
    pub s: [u8; 32],
}

/// The seal of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Seal {
    /// The participant that sent the message.
    pub sender: DeviceId,
    /// Number of the sender's session, higher than those of its earlier sessions.
    pub session: u64,
    /// Number of the message among the sealed messages of the session, from 1.
    pub count: u64,
    /// The sender's signature of [`statement`].
    pub signature: Signature,
}

/// A decoded message with its seal.
#[derive(Clone, Debug, PartialEq)]
pub struct Sealed<'a> {
    /// The message.
    pub message: Message<'a>,
    /// The seal; `None` if the message has none.
    pub seal: Option<Seal>,
    /// The bytes that the signature covers, without prefix and topic.
    pub signed: &'a [u8],
}

/// The bytes that a seal's signature covers, one after the other: a prefix, the text of the topic, a zero, and the encoded
/// message with its seal up to the signature.
pub fn statement<'a>(topic: &'a str, signed: &'a [u8]) -> [&'a [u8]; 4] {
    [STATEMENT, topic.as_bytes(), &[0], signed]
}

/// Seals an encoded message. `sign` gets the bytes for [`statement`]. Writes the sealed message to the start of `out`, and
/// returns the written bytes: [`MAX_SEAL_BYTES`] more than `encoded` are enough.
pub fn seal<'o>(
    encoded: &[u8],
    (sender, session, count): (DeviceId, u64, u64),
    sign: impl FnOnce(&[u8]) -> Signature,
    out: &'o mut [u8],
) -> Result<&'o [u8], WireError> {
    let content = encoded.len().checked_sub(CHECKSUM_BYTES).ok_or(WireError::Malformed)?;
    let (start, rest) = out.split_at_mut_checked(content).ok_or(WireError::BufferTooSmall)?;
    start.copy_from_slice(&encoded[..content]);
    let small = |_| WireError::BufferTooSmall;
    let signed = content + postcard::to_slice(&(sender, session, count), rest).map_err(small)?.len();
    let signature = sign(&out[..signed]);
    let used = signed + postcard::to_slice(&signature, &mut out[signed..]).map_err(small)?.len();
    let (content, rest) = out.split_at_mut(used);
    let checksum = rest.first_chunk_mut().ok_or(WireError::BufferTooSmall)?;
    *checksum = crc32fast::hash(content).to_le_bytes();
    Ok(&out[..used + CHECKSUM_BYTES])
}

impl<'a> Sealed<'a> {
    /// Decodes a message and its seal, if it has one. Does not check the signature.
    pub fn decode(bytes: &'a [u8]) -> Result<Self, WireError> {
        let content = Message::content(bytes)?;
        let (message, rest) = Message::take(content)?;
        if rest.is_empty() {
            return Ok(Self { message, seal: None, signed: content });
        }
        let is_chunk = matches!(message, Message::Chunk(_));
        let (seal, trailing): (Seal, _) =
            postcard::take_from_bytes(rest).map_err(|_| WireError::TrailingBytes)?;
        if is_chunk || !trailing.is_empty() {
            return Err(WireError::TrailingBytes);
        }
        Ok(Self { message, seal: Some(seal), signed: &content[..content.len() - SIGNATURE_BYTES] })
    }
}

impl<'a> Message<'a> {
    /// Decodes a message. Leaves out its seal: see [`Sealed`]. The payload of a chunk and the cameras of a flight are
    /// borrowed from `bytes`.
    pub fn decode(bytes: &'a [u8]) -> Result<Self, WireError> {
        Sealed::decode(bytes).map(|sealed| sealed.message)
    }

    /// Decodes the header of a stored model, which may be of the version before.
    pub fn decode_stored(bytes: &'a [u8]) -> Result<Self, WireError> {
        let before = Err(WireError::UnknownVersion(VERSION_BEFORE));
        let decoded = Self::decode(bytes);
        if decoded != before {
            return decoded;
        }
        // Behind the header is its signature, which is not kept.
        match Self::take(&bytes[..bytes.len() - CHECKSUM_BYTES])? {
            (message @ Self::Header(_), _) => Ok(message),
            _ => before,
        }
    }
}
