//! Sends and receives models: the protocol of [`cosurf_wire`] as state machines, and the transports that
//! carry its messages.
//!
//! What it knows nothing about: training, merging, and where files are kept. Only the transports read clocks.
//!
//! [`Uploader`] and [`Inbox`] take messages and `now` (a [`std::time::Duration`] since any fixed moment).
//! They return the messages to publish and the models to store. A test can therefore simulate a whole fleet
//! in one thread over [`MemoryNetwork`], and the same seed repeats the same run.
//!
//! Where to start reading: [`node`] combines the state machines of one participant. [`uploader`] and
//! [`inbox`] are the sending and the receiving half of the protocol. [`transport`] is the interface to the
//! network.

mod arrived;
mod bits;
pub mod body;
pub mod codec;
pub mod faults;
mod guard;
mod identity;
pub mod inbox;
mod key;
pub mod manifest;
pub mod memory;
pub mod mqtt;
pub mod node;
pub mod offer;
mod pacing;
mod peer;
pub mod received;
pub mod recording;
mod sealing;
pub mod serial;
mod session;
pub mod store;
mod transfer;
pub mod transport;
pub mod trust;
pub mod uploader;

pub use body::{BodyFault, Model};
pub use codec::{
    FirstLayer, body_frame, body_to_model, check_body, model_to_body, part_to_model, plain_importance,
    scene_frame,
};
pub use faults::{Faults, Line, Outages};
pub use identity::{Identity, Role};
pub use inbox::{Inbox, InboxLimits};
pub use key::ModelKey;
pub use manifest::{Manifest, Receiver, TileEntry};
pub use memory::{MemoryNetwork, MemoryTransport};
pub use mqtt::{BrokerAddress, Login, MqttConfig, MqttTransport, Tls, TlsFiles, is_present, probe};
pub use node::{
    Node, NodeEvent, PlannedCell, UploadFault, flight_hash, select_flight_cameras, upload_blocking,
};
pub use offer::Offer;
pub use received::{Complete, ReceiveError, Received};
pub use sealing::last_will;
pub use serial::{SerialConfig, SerialTransport};
pub use session::next_session;
pub use store::{Damaged, ModelStore, StoreError};
pub use transport::{Outgoing, PublishError, Transport, TransportEvent};
pub use trust::{Credentials, CredentialsError, SecretKey, Trusted};
pub use uploader::{DEVICES_MAX, UploadProgress, Uploader};
