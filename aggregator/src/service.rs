//! The receiving service: receives local models, verifies, stores and merges them, and broadcasts the global
//! model.
//!
//! What is on the disk decides: a service that is stopped and started again goes on from its folder:
//!
//! | in the folder | |
//! |---|---|
//! | `models/` | every local model as it arrived |
//! | `parts/` | what had arrived of other models when models were merged: [`crate::merge::fill_in()`] |
//! | `global/` | every revision of the global model, as sent to the agents |
//! | `global.ply` | the newest revision, for viewers |
//! | `merged.json` | what the newest revision was merged from, and how |
//! | `withdrawn/` | withdrawn devices, each with its last model that no longer counts |
//! | `upstream/` | models from the aggregator above, if there is one: [`upstream`] |
//!
//! The newest model of each device counts, unless it contradicts the others ([`crate::gate`]); they are merged in
//! order of device id, so the same models give the same bytes in whatever order they arrive. Merging runs on a thread
//! of its own while the service goes on listening; what arrives meanwhile makes it begin anew. Of a device that has sent
//! none as a whole what has arrived so far is used ([`crate::merge::fill_in()`]).
//!
//! It refuses to know photographs, how agents train and how they are started: it knows them by what arrives.
//!
//! Where to start reading: [`serve()`], all that `cosurf-aggregator run` does; [`Service`], the loop; [`keeper`] for
//! the service's state and actions, [`round`] for when models are merged, [`upstream`] for an aggregator below another one.

mod config;
mod control;
mod error;
mod event;
mod folder;
mod job;
mod keeper;
mod parts;
mod receive;
mod record;
mod round;
mod serve;
mod shelf;
mod station;
#[cfg(test)]
mod tests;
mod upstream;

pub use config::{AggregatorConfig, ConfigError, UpstreamConfig};
pub(crate) use control::BROKER_ATTEMPTS_MAX;
pub use control::{Command, ServiceConfig};
pub use error::ServiceError;
pub use event::ServiceEvent;
pub use folder::global_ply;
pub(crate) use folder::joined;
pub use receive::Service;
pub use record::{Fitted, KeptOut, Merging, withdraw};
pub use round::{Expected, Rounds};
pub use serve::{Host, ServeError, SideEvent, serve};
pub(crate) use station::Station;
pub use upstream::UpstreamEvent;
pub(crate) use upstream::{Upstream, UpstreamNode};
