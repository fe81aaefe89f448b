//! A node: one participant with its inbox, its uploads and its session, on one transport.
//!
//! The module `state` has [`Node`] and the calls that change it. `receive` handles incoming messages, and
//! `send` produces outgoing ones. [`Node::step`] receives and sends.

mod asking;
mod births;
mod confirm;
mod event;
mod flight;
mod log;
mod lost;
mod planning;
mod pledge;
mod receive;
mod send;
mod state;
mod step;
mod upload;

pub use event::NodeEvent;
pub use flight::{flight_hash, select_flight_cameras};
pub use planning::PlannedCell;
pub use state::Node;
pub use upload::{UploadFault, upload_blocking};
