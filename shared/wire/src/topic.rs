//! MQTT topics, written and read back. The first level after `gs/v1/{site}` is the writing device, or
//! `global`, or for the aggregator's answers the device they are for, so that a broker's access list can
//! hold every device to its own branch: `gs/v1/{site}/%u/#`.

use core::fmt::{self, Write};

use crate::id::{DeviceId, IdError, ModelId, SiteId, TileId, parse_decimal};

/// Longest topic in bytes: a chunk of a global model with all names at their longest.
pub const MAX_TOPIC_BYTES: usize = 176;

/// A topic as text.
pub type TopicString = heapless::String<MAX_TOPIC_BYTES>;

/// The first two levels: our name and the version of this layout.
const ROOT: &str = "gs/v1";

/// What a message is about, and whose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Topic {
    /// Birth and death of a device.
    State {
        /// Whose.
        device: DeviceId,
    },
    /// What a device has photographed.
    Flight {
        /// Whose.
        device: DeviceId,
    },
    /// The header of a device's model.
    LocalHeader {
        /// Who made it.
        device: DeviceId,
        /// Which of its models.
        model: ModelId,
    },
    /// A chunk of a device's model.
    LocalChunk {
        /// Who made it.
        device: DeviceId,
        /// Which of its models.
        model: ModelId,
        /// Which chunk, from 0.
        index: u32,
    },
    /// The aggregator's answer to a device about that device's model.
    LocalReply {
        /// Whom it answers.
        device: DeviceId,
        /// What it answers.
        reply: Reply,
    },
    /// The header of the newest global model of a tile.
    GlobalHeader {
        /// Which tile.
        tile: TileId,
    },
    /// A chunk of a global model.
    GlobalChunk {
        /// Which tile.
        tile: TileId,
        /// Which revision.
        model: ModelId,
        /// Which chunk, from 0.
        index: u32,
    },
    /// A device's answer to the aggregator about a global model.
    GlobalReply {
        /// Who answers.
        device: DeviceId,
        /// What it answers.
        reply: Reply,
    },
}

/// The answers a receiver gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reply {
    /// [`crate::Want`].
    Want,
    /// [`crate::Done`].
    Done,
    /// [`crate::Refused`].
    Refused,
}

impl Reply {
    fn as_str(self) -> &'static str {
        match self {
            Self::Want => "want",
            Self::Done => "done",
            Self::Refused => "refused",
        }
    }

    fn parse(level: &str) -> Result<Self, TopicError> {
        match level {
            "want" => Ok(Self::Want),
            "done" => Ok(Self::Done),
            "refused" => Ok(Self::Refused),
            _ => Err(TopicError::Unknown),
        }
    }
}

/// Why a text is no topic of ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum TopicError {
    /// It is none of the layouts above.
    Unknown,
    /// One of its levels is no valid name or number.
    Id(IdError),
}

impl fmt::Display for TopicError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unknown => write!(f, "not a topic of {ROOT}"),
            Self::Id(error) => error.fmt(f),
        }
    }
}

impl core::error::Error for TopicError {}

impl From<IdError> for TopicError {
    fn from(error: IdError) -> Self {
        Self::Id(error)
    }
}

impl Topic {
    /// The topic as text, below `site`.
    pub fn to_text(&self, site: &SiteId) -> TopicString {
        let mut text = TopicString::new();
        // Names and numbers are bounded, and a test writes the longest.
        let _ = write!(text, "{ROOT}/{site}/{self}");
        text
    }

    /// Reads a topic back: the site, and what is said there.
    pub fn parse(text: &str) -> Result<(SiteId, Self), TopicError> {
        let rest = text.strip_prefix(ROOT).and_then(|rest| rest.strip_prefix('/'));
        let (site, rest) = rest.and_then(|rest| rest.split_once('/')).ok_or(TopicError::Unknown)?;
        let site = SiteId::new(site)?;
        let mut split = rest.split('/');
        let levels: [Option<&str>; 6] = core::array::from_fn(|_| split.next());
        let topic = match levels {
            [Some("global"), Some(tile), Some("m"), None, ..] => {
                Self::GlobalHeader { tile: TileId::new(tile)? }
            }
            [Some("global"), Some(tile), Some(model), Some("c"), Some(index), None] => Self::GlobalChunk {
                tile: TileId::new(tile)?,
                model: model.parse()?,
                index: parse_index(index)?,
            },
            [Some(device), Some("state"), None, ..] => Self::State { device: DeviceId::new(device)? },
            [Some(device), Some("flight"), None, ..] => Self::Flight { device: DeviceId::new(device)? },
            [Some(device), Some("up"), Some(model), Some("m"), None, ..] => {
                Self::LocalHeader { device: DeviceId::new(device)?, model: model.parse()? }
            }
            [Some(device), Some("up"), Some(model), Some("c"), Some(index), None] => Self::LocalChunk {
                device: DeviceId::new(device)?,
                model: model.parse()?,
                index: parse_index(index)?,
            },
            [Some(device), Some("dn"), Some(reply), None, ..] => {
                Self::LocalReply { device: DeviceId::new(device)?, reply: Reply::parse(reply)? }
            }
            [Some(device), Some("global"), Some(reply), None, ..] => {
                Self::GlobalReply { device: DeviceId::new(device)?, reply: Reply::parse(reply)? }
            }
            _ => return Err(TopicError::Unknown),
        };
        Ok((site, topic))
    }

    /// What an aggregator of `site` subscribes to.
    pub fn aggregator_filters(site: &SiteId) -> [TopicString; 4] {
        ["+/state", "+/up/+/m", "+/up/+/c/+", "+/global/+"].map(|tail| filter(site, tail))
    }

    /// What `device` subscribes to.
    pub fn device_filters(site: &SiteId, device: &DeviceId) -> [TopicString; 3] {
        let mut own = filter(site, device.as_str());
        let _ = own.push_str("/dn/+");
        [own, filter(site, "global/#"), filter(site, "+/flight")]
    }
}

impl fmt::Display for Topic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::State { device } => write!(f, "{device}/state"),
            Self::Flight { device } => write!(f, "{device}/flight"),
            Self::LocalHeader { device, model } => write!(f, "{device}/up/{model}/m"),
            Self::LocalChunk { device, model, index } => write!(f, "{device}/up/{model}/c/{index}"),
            Self::LocalReply { device, reply } => write!(f, "{device}/dn/{}", reply.as_str()),
            Self::GlobalHeader { tile } => write!(f, "global/{tile}/m"),
            Self::GlobalChunk { tile, model, index } => write!(f, "global/{tile}/{model}/c/{index}"),
            Self::GlobalReply { device, reply } => write!(f, "{device}/global/{}", reply.as_str()),
        }
    }
}

fn filter(site: &SiteId, tail: &str) -> TopicString {
    let mut text = TopicString::new();
    let _ = write!(text, "{ROOT}/{site}/{tail}");
    text
}

fn parse_index(text: &str) -> Result<u32, IdError> {
    u32::try_from(parse_decimal(text)?).map_err(|_| IdError::NotANumber)
}
