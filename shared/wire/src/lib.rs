//! The data that drones and ground exchange: messages, topics, and the byte layout of a model's body.
//!
//! This crate knows no transport, clock, file or renderer. It is `no_std` and allocates nothing. Its
//! types bound every value, so the largest encoding of each message is a constant.
//!
//! Where to start reading: [`message`] for the protocol, [`topic`] for the MQTT topics, [`body`] for the
//! bytes of a model, [`frame`] for how messages cross a serial line.
//!
//! # The protocol
//!
//! A *sender* announces a model by its header and sends only the chunks that the *receiver* asks for.
//! Every message may be lost, duplicated, delayed or reordered. Handling a message twice has the same
//! effect as handling it once.
//!
//! | Message | from → to | Topic under `gs/v1/{site}` | retained | meaning |
//! |---|---|---|---|---|
//! | [`ModelHeader`] | device → aggregator | `/{device}/up/{model}/m` | yes | a model is offered: its sizes, bounds, frame, BLAKE3 hash, signature |
//! | [`Chunk`] | device → aggregator | `/{device}/up/{model}/c/{index}` | no | bytes `index * chunk_bytes ..` of the body |
//! | [`Want`] | aggregator → device | `/{device}/dn/want` | no | the chunks that the receiver has and lacks |
//! | [`Done`] | aggregator → device | `/{device}/dn/done` | no | the receiver has stored the body with this hash on disk |
//! | [`Refused`] | aggregator → device | `/{device}/dn/refused` | no | the receiver refuses the model, with the reason |
//! | [`ModelHeader`] | aggregator → devices | `/global/{tile}/m` | yes | the newest revision of the global model |
//! | [`Chunk`] | aggregator → devices | `/global/{tile}/{model}/c/{index}` | no | bytes of that model, sent once for all devices |
//! | [`Want`], [`Done`], [`Refused`] | device → aggregator | `/{device}/global/{want,done,refused}` | no | as above |
//! | [`FlightCameras`] | device → devices | `/{device}/flight` | yes | the cameras of the device's flight |
//! | [`State`] | device → all | `/{device}/state` | yes | start of a session, or its end (published as the MQTT last will) |
//!
//! A message is encoded as one byte of [`VERSION`], then
//! [postcard](https://postcard.jamesmunns.com/wire-format) (the variant's index, then its fields in
//! declaration order), then the CRC-32 (as in zip and Ethernet) of the bytes before it, little-endian.
//! The version byte and the checksum stay in these places in all versions. A damaged message is dropped,
//! as if it had been lost.
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

pub mod body;
mod cobs;
pub mod frame;
pub mod id;
pub mod message;
pub mod missing;
pub mod topic;

pub use body::{Bounds, CameraRecord};
pub use id::{DeviceId, FrameId, IdError, ModelId, SiteId, TileId};
pub use message::{
    BodyCodec, BodyHash, Chunk, Done, FLIGHT_CAMERAS_MAX, FlightCameras, HeaderError, MAX_CHUNK_BYTES,
    MAX_CONTROL_BYTES, MAX_MESSAGE_BYTES, Message, ModelHeader, ModelKind, RefusalReason, Refused, Signature,
    State, VERSION, Want, WireError,
};
pub use missing::{ChunkStatus, Missing};
pub use topic::{MAX_TOPIC_BYTES, Reply, Topic, TopicError, TopicString};
