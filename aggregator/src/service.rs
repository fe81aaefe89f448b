//! The receiving service: local models in, verified, kept on disk, joined; the global model out.
//!
//! It reads no photograph and knows no agent but by what arrives. What is on the disk decides: a
//! service that is stopped and started again goes on from its folder:
//!
//! | in the folder | |
//! |---|---|
//! | `models/` | every local model as it arrived |
//! | `parts/` | what had arrived of other models when models were merged: [`crate::merge::fill_in`] |
//! | `global/` | every revision of the global model, as sent to the agents |
//! | `global.ply` | the newest revision, for viewers |
//! | `merged.json` | what the newest revision was merged from, and how |
//! | `withdrawn/` | devices that do not count any more, each with its last model that does not |
//! | `upstream/` | what came from the aggregator above, where there is one: [`crate::upstream`] |
//!
//! The newest model of each device counts, unless it contradicts the others ([`crate::gate`]); they are merged in
//! order of device id, so the same models give the same bytes in whatever order they arrive. Merging runs on a thread
//! of its own while the service goes on listening; what arrives meanwhile makes it begin anew. Of a device that has sent
//! none as a whole what has arrived so far is used ([`crate::merge::fill_in`]).
//!
//! Reading order: [`Service`], [`round`] for when models are merged, [`keeper`] for what is kept and done.

mod job;
mod keeper;
mod parts;
mod record;
mod round;
mod shelf;

use std::collections::BTreeMap;
use std::fmt;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cosurf_link::{
    BodyFault, Credentials, Identity, InboxLimits, Model, ModelKey, ModelStore, Node, StoreError, Transport,
    body_to_model,
};
use cosurf_scene::SceneError;
use cosurf_scene::bytes::format_bytes;
use cosurf_wire::{DeviceId, ModelHeader, RefusalReason};

use serde::Serialize;

use crate::merge::{MergeError, MergeProgress, MergeSettings, concatenate};
#[cfg(test)]
pub(crate) use job::packed;
use keeper::{Keeper, Orders};
pub use record::{Fitted, KeptOut, Merging, withdraw};
pub use round::{Expected, Rounds};

/// How often the service looks up from listening.
const LOOK_UP: Duration = Duration::from_millis(50);

/// Attempts to reach the broker before an owner should give up. Once it has been reached there is no
/// limit: a service outlasts a broker that is down.
pub const BROKER_ATTEMPTS_MAX: u32 = 8;

/// What a service is and whom it serves.
#[derive(Clone, Debug)]
pub struct ServiceConfig {
    /// Who it is.
    pub identity: Identity,
    /// Its folder; see the module.
    pub folder: PathBuf,
    /// The most it takes in at once.
    pub limits: InboxLimits,
    /// When to merge models.
    pub expected: Expected,
    /// How to merge them.
    pub merge: MergeSettings,
    /// Threads to merge with, at least 1.
    pub threads: usize,
}

/// What the owner of a running service asks of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Do not wait for this device any more; what it sent still counts.
    GiveUp(DeviceId),
    /// Merge what is due, then end.
    Finish,
    /// End at once; a merge under way begins anew at the next start.
    Stop,
}

/// What a service tells its owner.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum ServiceEvent {
    /// The link stands (again).
    Connected,
    /// The link does not stand and is tried again.
    Disconnected {
        /// Failed attempts since it last stood, from 1.
        attempt: u32,
        /// One line.
        reason: String,
    },
    /// A model is safe on the disk.
    Stored {
        /// What is announced of it.
        header: ModelHeader,
    },
    /// The disk refused; it is tried again.
    DiskFailed {
        /// One line.
        reason: String,
    },
    /// A model has not arrived as a whole; what has is used until the rest is there.
    PartTaken {
        /// What has arrived, as a model of its own.
        header: ModelHeader,
        /// Splats of the whole.
        of_splats: u32,
    },
    /// A merge has come further.
    Merging(MergeProgress),
    /// A device does not count any more.
    Withdrawn {
        /// Which.
        device: DeviceId,
    },
    /// There is a new global model, safe on the disk.
    Merged {
        /// What is announced of it; the model's number is the revision.
        header: ModelHeader,
        /// Local models in it.
        models: usize,
        /// Local models that are not, for what they contradict.
        kept_out: Vec<KeptOut>,
    },
    /// There is no new global model: nobody is believed.
    NothingMerged {
        /// The local models.
        kept_out: Vec<KeptOut>,
    },
    /// Every agent that is still counted on has the global model on its disk.
    Delivered,
    /// An agent refuses the global model.
    Refused {
        /// Who.
        by: DeviceId,
        /// Why.
        reason: RefusalReason,
    },
    /// Two drones have one name: neither gets far.
    SameName {
        /// Which.
        device: DeviceId,
    },
    /// Something was heard and thrown away.
    Ignored {
        /// One line.
        reason: String,
    },
}

impl fmt::Display for ServiceEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Connected => write!(f, "connected to the broker"),
            Self::Disconnected { reason, .. } | Self::DiskFailed { reason } => write!(f, "{reason}"),
            Self::Stored { header } => {
                let size = format_bytes(header.body_bytes);
                write!(f, "the model of {} arrived: {} splats, {size}", header.device, header.splats)
            }
            Self::PartTaken { header, of_splats } => {
                let (device, splats) = (header.device, header.splats);
                write!(
                    f,
                    "of the model of {device} {splats} of {of_splats} splats have arrived; they are used"
                )
            }
            Self::Merging(MergeProgress { step, steps, psnr }) => {
                write!(f, "merging, step {step} of {steps}: {psnr:.2} dB of what the local models showed")
            }
            Self::Withdrawn { device } => write!(f, "{device} is withdrawn"),
            Self::Merged { header, models, kept_out } => {
                let (revision, splats) = (header.model, header.splats);
                write!(f, "global model, revision {revision}: {splats} splats of {models} models")?;
                kept_out.iter().try_for_each(|kept_out| write!(f, "; {kept_out} and is kept out"))
            }
            Self::NothingMerged { kept_out } => {
                write!(f, "no model is merged")?;
                kept_out.iter().try_for_each(|kept_out| write!(f, "; {kept_out}"))
            }
            Self::Delivered => write!(f, "every agent has the global model"),
            Self::Refused { by, reason } => write!(f, "{by} refuses the global model: {reason}"),
            Self::SameName { device } => {
                write!(f, "two drones call themselves {device}; give each a device name of its own")
            }
            Self::Ignored { reason } => write!(f, "ignored: {reason}"),
        }
    }
}

/// Why a service cannot work.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// A model could not be written or read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The PLY could not be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The models cannot be one.
    #[error("the models cannot be joined: {0}")]
    Body(#[from] BodyFault),
    /// The models are not merged.
    #[error(transparent)]
    Merge(#[from] MergeError),
}

/// A service with its folder open, not running yet.
#[derive(Debug)]
pub struct Service {
    node: Node,
    keeper: Keeper,
}

impl Service {
    /// Opens the folder, making it where it is missing.
    pub fn open(config: ServiceConfig) -> Result<Self, ServiceError> {
        let (identity, limits) = (config.identity, config.limits);
        let (keeper, known) = Keeper::open(config)?;
        Ok(Self { node: Node::new(identity, limits, &known), keeper })
    }

    /// Signs what it sends by these, and takes only what they believe.
    pub fn with(mut self, credentials: Credentials) -> Self {
        self.node.believe(credentials);
        self
    }

    /// Serves until told to finish, or until `on_event` breaks. Returns what is announced of the newest
    /// global model, if there is one.
    pub fn run<T: Transport>(
        mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        commands: &Receiver<Command>,
        mut on_event: impl FnMut(ServiceEvent) -> ControlFlow<()>,
    ) -> Option<ModelHeader> {
        let mut orders = Orders::GoOn;
        loop {
            orders = orders.max(self.keeper.obey(&self.node, commands, now()));
            let broke = self.step(transport, &now, LOOK_UP, &mut on_event).is_break();
            let ends = match orders {
                Orders::GoOn => false,
                Orders::Finish => !self.keeper.is_merging(),
                Orders::Stop => true,
            };
            if ends || broke {
                return self.keeper.global();
            }
        }
    }

    /// Whether models are being merged.
    #[cfg(test)]
    pub(crate) fn is_merging(&self) -> bool {
        self.keeper.is_merging()
    }

    /// Listens for at most `wait`, does what that asks for, and merges models when that is due.
    pub(crate) fn step<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
        mut on_event: impl FnMut(ServiceEvent) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let heard = self.node.step(transport, &now, wait);
        if let Some(event) = heard.and_then(|event| self.keeper.take(&mut self.node, event, now())) {
            on_event(event)?;
        }
        match self.keeper.work(&mut self.node, now()) {
            Some(event) => on_event(event),
            None => ControlFlow::Continue(()),
        }
    }
}

/// The newest model of each device in the folders of services, joined as they are.
pub(crate) fn joined(folders: &[PathBuf]) -> Result<Model, ServiceError> {
    let mut parts = Vec::new();
    for folder in folders {
        let (models, headers) = ModelStore::open(&folder.join("models"))?;
        let newest: BTreeMap<DeviceId, ModelHeader> =
            headers.into_iter().map(|header| (header.device, header)).collect();
        for header in newest.values() {
            parts.push(body_to_model(&models.get(ModelKey::from(header))?.1)?);
        }
    }
    Ok(concatenate(&parts))
}

/// Where a service with this folder keeps the revisions of its global model.
pub(crate) fn global_store(folder: &Path) -> PathBuf {
    folder.join("global")
}

/// Where a service with this folder keeps the newest global model for viewers.
pub fn global_ply(folder: &Path) -> PathBuf {
    folder.join("global.ply")
}

#[cfg(test)]
mod tests;
