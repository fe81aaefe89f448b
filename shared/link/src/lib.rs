//! Sends and receives models: the protocol of [`cosurf_wire`] as state machines, and the transports that
//! carry its messages.
//!
//! This crate knows no training, merging, file locations or clocks. [`Uploader`] and [`Inbox`] take
//! messages and `now` (a [`std::time::Duration`] since any fixed moment), and return the messages to publish
//! and the models to store. A whole fleet therefore runs in one test thread over [`MemoryNetwork`], from a
//! seed.
//!
//! Where to start reading: [`node`] combines the state machines of one participant, [`uploader`] and
//! [`inbox`] are the two halves of the protocol, [`transport`] is what carries it.

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
pub use codec::{FirstLayer, body_to_model, check_body, model_to_body, part_to_model, plain_importance};
pub use faults::{Faults, Line, Outages};
pub use identity::{Identity, Role};
pub use inbox::{Inbox, InboxLimits};
pub use key::ModelKey;
pub use memory::{MemoryNetwork, MemoryTransport};
pub use mqtt::{BrokerAddress, MqttConfig, MqttTransport, Tls, TlsFiles};
pub use node::{Node, NodeEvent, UploadFault, select_flight_cameras, upload_blocking};
pub use offer::Offer;
pub use serial::{SerialConfig, SerialTransport};
pub use session::next_session;
pub use store::{ModelStore, StoreError};
pub use transport::{Outgoing, PublishError, Transport, TransportEvent};
pub use trust::{Credentials, SecretKey, Trusted};
pub use uploader::{UploadProgress, Uploader};
