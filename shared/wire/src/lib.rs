//! The data that drones and ground exchange: messages, topics, and the byte layout of a model's body.
//!
//! What it knows nothing about: transports, clocks, files, rendering. The crate is `no_std` and allocates
//! nothing. The size of every value is limited, so the largest encoding of each message is a constant.
//!
//! Where to start reading: [`message`] has the messages of the protocol, [`topic`] the MQTT topics,
//! [`seal`] the signatures, [`flight`] how devices share ground, [`plan`] which ground a device observes, [`body`] the byte layout of a model, and [`frame`] the frames that carry messages over a serial line.
//!
//! # The protocol
//!
//! A *sender* announces a model by its header and sends only the chunks that the *receiver* asks for.
//! Every message may be lost, duplicated, delayed or reordered. Handling a message twice has the same
//! effect as handling it once.
//!
//! | Message | from → to | Topic under `gs/v1/{site}` | retained | meaning |
//! |---|---|---|---|---|
//! | [`ModelHeader`] | device → aggregator | `/{device}/up/{model}/m` | yes | offers a model |
//! | [`Chunk`] | device → aggregator | `/{device}/up/{model}/c/{index}` | no | a chunk of the body |
//! | [`Want`] | aggregator → device | `/{device}/dn/want` | no | the chunks that the receiver has and lacks |
//! | [`Done`] | aggregator → device | `/{device}/dn/done` | no | the body with this hash is stored on disk |
//! | [`Refused`] | aggregator → device | `/{device}/dn/refused` | no | the model is refused, with the reason |
//! | [`ModelHeader`] | aggregator → devices | `/global/{tile}/m` | yes | the newest revision of the global model, or the list of its tiles |
//! | [`Chunk`] | aggregator → devices | `/global/{tile}/{model}/c/{index}` | no | a chunk of a global model |
//! | [`ModelHeader`] | aggregator → device | `/{device}/dn/{model}/m` | no | offers a tile of the global model |
//! | [`Chunk`] | aggregator → device | `/{device}/dn/{model}/c/{index}` | no | a chunk of a tile |
//! | [`Want`] | device → aggregator | `/{device}/global/want` | no | chunks of a global model that the device lacks |
//! | [`Done`] | device → aggregator | `/{device}/global/done` | no | the device has stored a global model on disk |
//! | [`Refused`] | device → aggregator | `/{device}/global/refused` | no | the device refuses a global model |
//! | [`FlightCameras`] | device → devices | `/{device}/flight` | yes | the cameras of the device's flight |
//! | [`FlightPledge`] | device → aggregator | `/{device}/global/flight` | no | the device will send a model of its flight |
//! | [`ConfirmedFlights`] | aggregator → device | `/{device}/dn/flight` | no | the flights that count, of those that were pledged |
//! | [`Plan`] | aggregator → device | `/{device}/dn/plan` | no | the device's cell of the site's plan, or that it has none |
//! | [`State`] | device → all | `/{device}/state` | yes | start or end of a session (MQTT last will) |
//! | JSON | device → anybody | `/{device}/status` | yes | how far the device's agent is; no participant reads it |
//!
//! A global model that is too large to be sent whole is divided into tiles, each a model of its own. All devices get the
//! list of the tiles ([`ModelKind::Manifest`]), which also tells which device gets which tiles. A device accepts only
//! tiles that the newest list names for it. A tile that has not changed keeps its number, so it is sent once.
//!
//! A message is encoded as one byte of [`VERSION`], then
//! [postcard](https://postcard.jamesmunns.com/wire-format) (the variant's index, then its fields in
//! declaration order), then its [`Seal`] if the sender has a key and the message is not a chunk, then the CRC-32 (as in zip and Ethernet) of the bytes before it, little-endian. All
//! versions have the version byte first and the checksum last. A receiver drops a damaged message, as if it
//! had been lost.
//!
//! A reply (`Want`, `Done`, `Refused`) repeats the session of the offer that it answers, which the seal of the header
//! tells. So a reply to an offer of an earlier session is never taken for one to this session's offer.
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

pub mod body;
mod cobs;
pub mod flight;
pub mod frame;
mod hash;
pub mod id;
pub mod message;
pub mod missing;
pub mod plan;
pub mod seal;
pub mod topic;

pub use body::{Bounds, CameraRecord};
pub use flight::{
    CONFIRMED_FLIGHT_BYTES_MAX, CONFIRMED_FLIGHTS_MAX, ConfirmedFlights, FLIGHT_CAMERAS_MAX, FlightCameras,
    FlightPledge,
};
pub use hash::BodyHash;
pub use id::{DeviceId, FrameId, IdError, ModelId, SiteId, TileId};
pub use message::{
    BodyCodec, CAMERAS_MAX, Chunk, Done, HeaderError, MAX_CHUNK_BYTES, MAX_CHUNKS, MAX_CONTROL_BYTES,
    MAX_MESSAGE_BYTES, MIN_CHUNK_BYTES, Message, ModelHeader, ModelKind, RefusalReason, Refused, State,
    VERSION, Want, WireError,
};
pub use missing::{ChunkStatus, Missing};
pub use plan::{PLAN_COORDINATE_MAX, PLAN_CORNERS_MAX, Plan, VerticalAxis};
pub use seal::{MAX_SEAL_BYTES, Seal, Sealed, Signature};
pub use topic::{MAX_TOPIC_BYTES, Reply, Topic, TopicError, TopicString};
