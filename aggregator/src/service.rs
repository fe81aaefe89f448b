//! The receiving service: receives local models, verifies, stores and merges them, and broadcasts the global
//! model.
//!
//! All state of the service is in its folder, so a restarted service continues from what the folder holds:
//!
//! | in the folder | |
//! |---|---|
//! | `models/` | every local model as it arrived, and what has arrived of unfinished ones |
//! | `parts/` | the parts of unfinished uploads that the last merge used: [`crate::merge::fill_in()`] |
//! | `global/` | every revision of the global model |
//! | `global.ply` | the newest revision, for viewers |
//! | `merged.json` | what the newest revision was merged from, and how |
//! | `mesh.ply`, `report.html`, `report.json` | the report of the newest revision that has one: [`reporting`] |
//! | `sent/` | the tiles of the newest revision, if it is too large to be sent whole |
//! | `handed/` | what the agents get of the model of the aggregator above, if there is one: [`above`] |
//! | `withdrawn/` | a file for each withdrawn device, with the numbers and hashes of its models that no longer count |
//! | `revisions/` | for each revision in `global/`, what it was merged from: [`restore`] |
//! | `restore` | what the operator wishes: the number of a revision to restore, or a merge, a line each; `restore.lock` guards it |
//! | `held` | the number of the restored revision, as long as no merge may replace it |
//! | `revoked/` | a file for each revoked device: [`revoked`] |
//! | `replaced/` | a file for each device that has sent many models, with those that were removed as outdated |
//! | `upstream/` | models from the aggregator above, if there is one: [`upstream`] |
//! | `suspects.json`, `reading` | models that a merge was reading when the program died |
//! | `session` | the number of the last session |
//! | `actions.jsonl` | what operators have done in the page, if there is one: [`crate::station`] |
//!
//! The newest model of each device is merged, unless it contradicts the others ([`crate::gate`]). Models are merged in
//! the order of device ids, so their order of arrival does not change the bytes. A merge runs on its own thread while
//! the service keeps listening. If the models that count change before the merge ends, it starts over. A device without
//! a complete model contributes the part of a model that has arrived ([`crate::merge::fill_in()`]). If the service
//! accepts only trusted keys, it uses no parts, because the signature of a part cannot be checked.
//!
//! If nothing is left to merge after a withdrawal, `global.ply` and `merged.json` are removed. `global/` keeps all
//! revisions, so that the next one has a higher number.
//!
//! What it knows nothing about: photographs, how agents train, and how agents are started. It knows agents only by
//! their messages.
//!
//! Where to start reading: [`serve()`], all that `cosurf-aggregator run` does; [`Service`], the loop; [`keeper`] for
//! the service's state and actions, [`round`] for when models are merged, [`upstream`] and [`above`] for an aggregator
//! below another one.

mod above;
mod bound;
mod checked;
mod config;
mod control;
mod cut;
mod error;
mod event;
mod flights;
mod folder;
mod inputs;
mod job;
mod keeper;
mod model_list;
mod pack;
mod parts;
mod rebroadcast;
mod receive;
mod record;
mod reporting;
mod restore;
mod revoked;
mod round;
mod sent;
mod serve;
mod set_aside;
mod shelf;
mod site_plan;
mod station;
mod statuses;
#[cfg(test)]
mod tests;
mod trial;
mod upstream;

pub(crate) use above::AboveLink;
pub use bound::MemoryBound;
pub use config::{AggregatorConfig, TlsConfig, UpstreamConfig, WrongTls};
pub(crate) use control::BROKER_ATTEMPTS_MAX;
pub use control::{Command, ServiceConfig};
pub use error::ServiceError;
pub use event::ServiceEvent;
pub use folder::{global_ply, senders};
pub(crate) use folder::{global_store, write_joined};
pub use receive::Service;
pub use record::{Contribution, FitRecord, Fitted, KeptOut, Merging, contributions, withdraw};
pub(crate) use record::{file_hash, remove, withdrawn};
pub use reporting::{ReportError, ReportTask, Reported, Reporter};
pub(crate) use restore::record_of;
pub use restore::{OldRevision, RestoreError, ask_to_release, ask_to_restore, lost_revisions, old_revisions};
pub use revoked::{readmit, revoke, revoked};
pub use round::{Expected, Rounds};
pub(crate) use sent::SentTiles;
pub use serve::{Host, ServeError, SideEvent, expected_devices, neighbours, serve};
pub(crate) use station::Station;
pub use statuses::DeviceStatus;
pub use upstream::UpstreamEvent;
pub(crate) use upstream::{Upstream, UpstreamNode};
