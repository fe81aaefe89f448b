//! Formats and parses MQTT topics. The level after `gs/v1/{site}` is `global` for global models, the
//! receiving device for the aggregator's replies, and the publishing device for everything else. A broker's
//! access list can therefore restrict each device to publishing in its own branch, `gs/v1/{site}/%u/#`
//! (`%u` is the user name in Mosquitto's notation).

use core::fmt::{self, Write};

use crate::id::{DeviceId, IdError, ModelId, SiteId, TileId, parse_decimal};

/// Maximum length of a topic in bytes. The longest topic is that of a chunk of a global model.
pub const MAX_TOPIC_BYTES: usize = 176;

/// A topic as text.
pub type TopicString = heapless::String<MAX_TOPIC_BYTES>;

/// The first two levels of every topic: the protocol's name and the version of the topic layout.
const ROOT: &str = "gs/v1";

/// A topic of the protocol, without the site: the kind of message, and the device or tile that the message
/// is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Topic {
    /// Start and end of a device's sessions.
    State {
        /// The device that sends the message.
        device: DeviceId,
    },
    /// The cameras of a device's flight.
    Flight {
        /// The device that sends the message.
        device: DeviceId,
    },
    /// How far a device's agent is, as JSON for people and other programs. No participant reads it.
    Status {
        /// The device that sends the message.
        device: DeviceId,
    },
    /// The header of a device's model.
    LocalHeader {
        /// The device that made the model.
        device: DeviceId,
        /// Number of the model, counted by the device that made it.
        model: ModelId,
    },
    /// A chunk of a device's model.
    LocalChunk {
        /// The device that made the model.
        device: DeviceId,
        /// Number of the model, counted by the device that made it.
        model: ModelId,
        /// Index of the chunk, from 0.
        index: u32,
    },
    /// The aggregator's reply to a device about that device's model.
    LocalReply {
        /// The device that the reply is for.
        device: DeviceId,
        /// The kind of reply.
        reply: Reply,
    },
    /// The header of a tile of the global model, for one device.
    TileHeader {
        /// The device that the tile is for.
        device: DeviceId,
        /// Number of the tile.
        model: ModelId,
    },
    /// A chunk of a tile of the global model, for one device.
    TileChunk {
        /// The device that the tile is for.
        device: DeviceId,
        /// Number of the tile.
        model: ModelId,
        /// Index of the chunk, from 0.
        index: u32,
    },
    /// The header of the newest global model of a tile.
    GlobalHeader {
        /// The tile that the model covers.
        tile: TileId,
    },
    /// A chunk of a global model.
    GlobalChunk {
        /// The tile that the model covers.
        tile: TileId,
        /// The model's revision.
        model: ModelId,
        /// Index of the chunk, from 0.
        index: u32,
    },
    /// A device's reply to the aggregator about a global model.
    GlobalReply {
        /// The device that replies.
        device: DeviceId,
        /// The kind of reply.
        reply: Reply,
    },
}

/// The kinds of replies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reply {
    /// [`crate::Want`].
    Want,
    /// [`crate::Done`].
    Done,
    /// [`crate::Refused`].
    Refused,
    /// [`crate::ConfirmedFlights`] to a device, [`crate::FlightPledge`] from it.
    Flight,
    /// [`crate::Plan`], to a device only.
    Plan,
}

impl Reply {
    fn as_str(self) -> &'static str {
        match self {
            Self::Want => "want",
            Self::Done => "done",
            Self::Refused => "refused",
            Self::Flight => "flight",
            Self::Plan => "plan",
        }
    }

    fn parse(level: &str) -> Result<Self, TopicError> {
        match level {
            "want" => Ok(Self::Want),
            "done" => Ok(Self::Done),
            "refused" => Ok(Self::Refused),
            "flight" => Ok(Self::Flight),
            "plan" => Ok(Self::Plan),
            _ => Err(TopicError::Unknown),
        }
    }
}

/// Why a text is not a topic of the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum TopicError {
    /// The text does not have the form of any [`Topic`].
    Unknown,
    /// A level of the topic is not a valid name or number.
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
    /// Formats the topic as text, with the levels of the protocol and of `site` in front.
    pub fn to_text(&self, site: &SiteId) -> TopicString {
        let mut text = TopicString::new();
        // Cannot fail: the length of every level is limited, and the longest topic has MAX_TOPIC_BYTES.
        let _ = write!(text, "{ROOT}/{site}/{self}");
        text
    }

    /// Parses the text of a topic, and returns the site and the topic.
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
            [Some(device), Some("status"), None, ..] => Self::Status { device: DeviceId::new(device)? },
            [Some(device), Some("up"), Some(model), Some("m"), None, ..] => {
                Self::LocalHeader { device: DeviceId::new(device)?, model: model.parse()? }
            }
            [Some(device), Some("up"), Some(model), Some("c"), Some(index), None] => Self::LocalChunk {
                device: DeviceId::new(device)?,
                model: model.parse()?,
                index: parse_index(index)?,
            },
            [Some(device), Some("dn"), Some(model), Some("m"), None, ..] => {
                Self::TileHeader { device: DeviceId::new(device)?, model: model.parse()? }
            }
            [Some(device), Some("dn"), Some(model), Some("c"), Some(index), None] => Self::TileChunk {
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

    /// Whether the broker keeps the newest message of this topic for later subscribers. No participant retains messages of
    /// other topics.
    pub fn is_retained(&self) -> bool {
        matches!(
            self,
            Self::State { .. }
                | Self::Flight { .. }
                | Self::Status { .. }
                | Self::LocalHeader { .. }
                | Self::GlobalHeader { .. }
        )
    }

    /// The topic filters that an aggregator of `site` subscribes to.
    pub fn aggregator_filters(site: &SiteId) -> [TopicString; 4] {
        ["+/state", "+/up/+/m", "+/up/+/c/+", "+/global/+"].map(|tail| filter(site, tail))
    }

    /// The topic filter of the statuses of all devices of `site`.
    pub fn status_filter(site: &SiteId) -> TopicString {
        filter(site, "+/status")
    }

    /// The topic filters that `device` subscribes to.
    pub fn device_filters(site: &SiteId, device: &DeviceId) -> [TopicString; 3] {
        let mut own = filter(site, device.as_str());
        let _ = own.push_str("/dn/#");
        [own, filter(site, "global/#"), filter(site, "+/flight")]
    }
}

impl fmt::Display for Topic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::State { device } => write!(f, "{device}/state"),
            Self::Flight { device } => write!(f, "{device}/flight"),
            Self::Status { device } => write!(f, "{device}/status"),
            Self::LocalHeader { device, model } => write!(f, "{device}/up/{model}/m"),
            Self::LocalChunk { device, model, index } => write!(f, "{device}/up/{model}/c/{index}"),
            Self::LocalReply { device, reply } => write!(f, "{device}/dn/{}", reply.as_str()),
            Self::TileHeader { device, model } => write!(f, "{device}/dn/{model}/m"),
            Self::TileChunk { device, model, index } => write!(f, "{device}/dn/{model}/c/{index}"),
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
