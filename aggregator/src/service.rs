//! The receiving service: local models in, verified, kept on disk, joined; the global model out.
//!
//! It reads no photograph and knows no agent but by what arrives. What is on the disk decides: a
//! service that is stopped and started again goes on from its folder:
//!
//! | in the folder | |
//! |---|---|
//! | `models/` | every local model as it arrived |
//! | `global/` | every revision of the global model, as sent to the agents |
//! | `global.ply` | the newest revision, for viewers |
//!
//! The newest model of each device counts; they are joined in order of device id, so the same models
//! give the same bytes in whatever order they arrive.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Duration;

use cosurf_link::{
    BodyFault, Identity, InboxLimits, Model, ModelKey, ModelStore, Node, NodeEvent, Offer, StoreError,
    Transport, body_to_model,
};
use cosurf_scene::bytes::format_bytes;
use cosurf_scene::{SceneError, ply};
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind, RefusalReason, TileId};

use serde::Serialize;

use crate::merge::concatenate;

/// How often the service looks up from listening.
const LOOK_UP: Duration = Duration::from_millis(50);
/// Pause before what the disk refused is tried again.
const DISK_RETRY: Duration = Duration::from_secs(5);

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
    /// When to join models.
    pub expected: Expected,
}

/// When models are joined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Expected {
    /// Once each of these devices has sent one.
    Fleet(BTreeSet<DeviceId>),
    /// Whenever one arrives, from anybody.
    Anybody,
}

/// What the owner of a running service asks of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Do not wait for this device any more; what it sent still counts.
    GiveUp(DeviceId),
    /// Join what is due, then end.
    Finish,
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
    /// There is a new global model, safe on the disk.
    Merged {
        /// What is announced of it; the model's number is the revision.
        header: ModelHeader,
        /// Local models in it.
        models: usize,
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
            Self::Merged { header, models } => {
                write!(
                    f,
                    "global model, revision {}: {} splats of {models} models",
                    header.model, header.splats
                )
            }
            Self::Delivered => write!(f, "every agent has the global model"),
            Self::Refused { by, reason } => write!(f, "{by} refuses the global model: {reason}"),
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
        let (models, headers) = ModelStore::open(&config.folder.join("models"))?;
        let (globals, revisions) = ModelStore::open(&config.folder.join("global"))?;
        let mut keeper = Keeper {
            device: config.identity.device,
            folder: config.folder,
            models,
            globals,
            newest: BTreeMap::new(),
            global: revisions.into_iter().max_by_key(|header| header.model),
            expected: config.expected,
            given_up: BTreeSet::new(),
            merge_at: Some(Duration::ZERO),
        };
        headers.iter().for_each(|header| keeper.note(header));
        Ok(Self { node: Node::new(config.identity, config.limits, &headers), keeper })
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
        loop {
            let finish = self.keeper.obey(commands);
            let broke = self.step(transport, &now, LOOK_UP, &mut on_event).is_break();
            if finish || broke {
                return self.keeper.global;
            }
        }
    }

    /// Listens for at most `wait`, does what that asks for, and joins models when that is due.
    fn step<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
        mut on_event: impl FnMut(ServiceEvent) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let heard = self.node.step(transport, &now, wait);
        if let Some(event) = heard.and_then(|event| self.keeper.take(&mut self.node, event)) {
            on_event(event)?;
        }
        match self.keeper.merge_when_due(&mut self.node, now()) {
            Some(event) => on_event(event),
            None => ControlFlow::Continue(()),
        }
    }
}

/// What the service has and does with it.
#[derive(Debug)]
struct Keeper {
    device: DeviceId,
    folder: PathBuf,
    models: ModelStore,
    globals: ModelStore,
    /// The newest model of each device.
    newest: BTreeMap<DeviceId, ModelHeader>,
    global: Option<ModelHeader>,
    expected: Expected,
    given_up: BTreeSet<DeviceId>,
    /// When to join models next, if there is anything to join.
    merge_at: Option<Duration>,
}

impl Keeper {
    fn take(&mut self, node: &mut Node, event: NodeEvent) -> Option<ServiceEvent> {
        Some(match event {
            NodeEvent::Connected => ServiceEvent::Connected,
            NodeEvent::Disconnected { attempt, reason } => ServiceEvent::Disconnected { attempt, reason },
            NodeEvent::Store { header, body } => self.store(node, header, &body),
            NodeEvent::Ignored { topic, reason } => {
                ServiceEvent::Ignored { reason: format!("{topic}: {reason}") }
            }
            NodeEvent::Uploaded(..) => ServiceEvent::Delivered,
            NodeEvent::UploadRefused { by, reason, .. } => ServiceEvent::Refused { by, reason },
            NodeEvent::Refused { key, reason } => {
                ServiceEvent::Ignored { reason: format!("model {key} is refused: {reason}") }
            }
            NodeEvent::LinkTooNarrow(error) => {
                ServiceEvent::Ignored { reason: format!("the link does not take our messages: {error}") }
            }
            NodeEvent::State(_) | NodeEvent::Receiving(_) | NodeEvent::Known(_) | NodeEvent::Progress(..) => {
                return None;
            }
        })
    }

    fn store(&mut self, node: &mut Node, header: ModelHeader, body: &[u8]) -> ServiceEvent {
        let key = ModelKey { device: header.device, model: header.model };
        if let Err(error) = self.models.put(&header, body) {
            node.store_failed(key);
            return ServiceEvent::DiskFailed { reason: format!("model {key} is not stored: {error}") };
        }
        node.stored(key);
        self.note(&header);
        self.merge_at = Some(Duration::ZERO);
        ServiceEvent::Stored { header }
    }

    /// Counts a stored model, unless a newer one of the same device is known.
    fn note(&mut self, header: &ModelHeader) {
        let newest = self.newest.entry(header.device).or_insert(*header);
        if newest.model < header.model {
            *newest = *header;
        }
    }

    /// Does what was asked for; returns whether to finish.
    fn obey(&mut self, commands: &Receiver<Command>) -> bool {
        loop {
            match commands.try_recv() {
                Ok(Command::GiveUp(device)) => {
                    self.given_up.insert(device);
                    self.merge_at = Some(Duration::ZERO);
                }
                Ok(Command::Finish) | Err(TryRecvError::Disconnected) => return true,
                Err(TryRecvError::Empty) => return false,
            }
        }
    }

    fn merge_when_due(&mut self, node: &mut Node, now: Duration) -> Option<ServiceEvent> {
        if self.merge_at.is_none_or(|at| now < at) {
            return None;
        }
        self.merge_at = None;
        if !self.is_complete() {
            return None;
        }
        match self.merge(node) {
            Ok(event) => Some(event),
            Err(error) => {
                self.merge_at = Some(now + DISK_RETRY);
                Some(ServiceEvent::DiskFailed { reason: format!("the global model is not stored: {error}") })
            }
        }
    }

    fn is_complete(&self) -> bool {
        let here = |device: &DeviceId| self.newest.contains_key(device) || self.given_up.contains(device);
        let complete = match &self.expected {
            Expected::Fleet(fleet) => fleet.iter().all(here),
            Expected::Anybody => true,
        };
        complete && !self.newest.is_empty()
    }

    /// Joins, stores and offers the global model. The same bytes keep their revision.
    fn merge(&mut self, node: &mut Node) -> Result<ServiceEvent, ServiceError> {
        let models = self.newest.values().map(|header| self.load(header)).collect::<Result<Vec<_>, _>>()?;
        let Model { splats, cameras } = concatenate(&models);
        let views = self.newest.values().fold(0u32, |views, header| views.saturating_add(header.views));
        let next = ModelId(self.global.map_or(1, |global| global.model.0 + 1));
        let mut offer = Offer::new(self.device, next, ModelKind::Global, views, &splats, &cameras)?;
        match self.global {
            Some(global) if global.blake3 == offer.header.blake3 => offer.header = global,
            _ => self.globals.put(&offer.header, &offer.body)?,
        }
        ply::write(&global_ply(&self.folder), &splats)?;
        let header = offer.header;
        self.global = Some(header);
        let receivers: Vec<DeviceId> = self.receivers().collect();
        node.broadcast(TileId::WHOLE, offer, &receivers);
        Ok(ServiceEvent::Merged { header, models: models.len() })
    }

    fn load(&self, header: &ModelHeader) -> Result<Model, ServiceError> {
        let (_, body) = self.models.get(ModelKey { device: header.device, model: header.model })?;
        Ok(body_to_model(&body)?)
    }

    fn receivers(&self) -> impl Iterator<Item = DeviceId> {
        self.newest.keys().filter(|device| !self.given_up.contains(device)).copied()
    }
}

/// Where a service with this folder keeps the newest global model for viewers.
pub fn global_ply(folder: &Path) -> PathBuf {
    folder.join("global.ply")
}

#[cfg(test)]
mod tests;
