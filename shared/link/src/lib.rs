//! Models out, models in: the conversation of [`cosurf_wire`] as state machines, and the transports
//! that carry it.
//!
//! What it refuses to know: training, merging, files' places, clocks. [`Uploader`] and [`Inbox`] take
//! `now` (a [`std::time::Duration`] since any fixed moment) and messages, and return what to publish and
//! what to store; so a whole fleet runs in one test thread over [`MemoryNetwork`], from a seed.
//!
//! Where to start reading: [`node`], which holds the machines of one participant together, then
//! [`uploader`] and [`inbox`] for the conversation's two halves, then [`transport`].

mod bits;
pub mod body;
pub mod codec;
pub mod faults;
mod identity;
pub mod inbox;
mod key;
pub mod memory;
pub mod mqtt;
pub mod node;
pub mod offer;
mod pacing;
mod peer;
pub mod recording;
pub mod serial;
mod session;
pub mod store;
mod transfer;
pub mod transport;
pub mod trust;
pub mod uploader;

pub use body::{BodyFault, Model};
pub use codec::{First, body_to_model, check_body, model_to_body, part_to_model, plain_importance};
pub use faults::{Faults, Line, Outages};
pub use identity::{Identity, Role};
pub use inbox::{Inbox, InboxLimits};
pub use key::ModelKey;
pub use memory::{MemoryNetwork, MemoryTransport};
pub use mqtt::{BrokerAddress, MqttConfig, MqttTransport, Tls};
pub use node::{Node, NodeEvent, UploadFault, told_cameras, upload_blocking};
pub use offer::Offer;
pub use serial::{SerialConfig, SerialTransport};
pub use session::next_session;
pub use store::{ModelStore, StoreError};
pub use transport::{Outgoing, PublishError, Transport, TransportEvent};
pub use trust::{Credentials, SecretKey, Trusted};
pub use uploader::{UploadProgress, Uploader};
