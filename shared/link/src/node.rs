//! A node: one participant with its inbox, its uploads and its session, on one transport.
//!
//! [`Node`] and the calls of its user are in `state`, the handling of incoming messages in `receive`, that of outgoing
//! messages in `send`. [`Node::step`] runs both.

mod births;
mod event;
mod flight;
mod receive;
mod send;
mod state;
mod step;
mod upload;

pub use event::NodeEvent;
pub use flight::told_cameras;
pub use state::Node;
pub use upload::{UploadFault, upload_blocking};
