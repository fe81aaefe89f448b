//! What travels between drones and ground: messages, topics, and the layout of a model's body.
//!
//! What it refuses to know: transports, clocks, files, rendering. It is `no_std` and allocates
//! nothing; every value is bounded by its type, so the largest encoding of each message is a constant.
//!
//! Where to start reading: [`message`] for the conversation, [`topic`] for where it is held,
//! [`body`] for what a model looks like as bytes, [`frame`] for how messages cross a serial line.
//!
//! # The conversation
//!
//! A *sender* announces a model by its header and sends only the chunks that the *receiver* wants.
//! Every message may be lost, doubled, delayed or reordered; none is acted on twice to a different end.
//!
//! | Message | from → to | Topic under `gs/v1/{site}` | retained | means |
//! |---|---|---|---|---|
//! | [`ModelHeader`] | device → aggregator | `/{device}/up/{model}/m` | yes | this model exists; sizes, bounds, frame, BLAKE3, signature |
//! | [`Chunk`] | device → aggregator | `/{device}/up/{model}/c/{index}` | no | bytes `index * chunk_bytes ..` of the body |
//! | [`Want`] | aggregator → device | `/{device}/dn/want` | no | what I have, and what I still lack |
//! | [`Done`] | aggregator → device | `/{device}/dn/done` | no | the body with this hash is on my disk |
//! | [`Refused`] | aggregator → device | `/{device}/dn/refused` | no | I will not take it, and why |
//! | [`ModelHeader`] | aggregator → devices | `/global/{tile}/m` | yes | the newest revision of the global model |
//! | [`Chunk`] | aggregator → devices | `/global/{tile}/{model}/c/{index}` | no | its bytes, to all at once |
//! | [`Want`], [`Done`], [`Refused`] | device → aggregator | `/{device}/global/{want,done,refused}` | no | as above |
//! | [`Flight`] | device → devices | `/{device}/flight` | yes | what I have photographed |
//! | [`State`] | device → all | `/{device}/state` | yes | birth, or by the last will death, of a session |
//!
//! Every message is one byte of [`VERSION`], then [postcard](https://postcard.jamesmunns.com/wire-format)
//! (the variant's index, then its fields in the order of their declaration), then the CRC-32 (of zip and
//! Ethernet) of all that, little-endian. Every version keeps its first byte and
//! its checksum there. A damaged message is thrown away like a lost one.
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
    BodyCodec, BodyHash, Chunk, Done, FLIGHT_CAMERAS_MAX, Flight, HeaderError, MAX_CHUNK_BYTES,
    MAX_CONTROL_BYTES, MAX_MESSAGE_BYTES, Message, ModelHeader, ModelKind, RefusalReason, Refused, Signature,
    State, VERSION, Want, WireError,
};
pub use missing::{Knowledge, Missing};
pub use topic::{MAX_TOPIC_BYTES, Reply, Topic, TopicError, TopicString};
