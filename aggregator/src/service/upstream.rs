//! The way up: an aggregator with another above it (an edge below its cloud) is a device to that one.
//!
//! Every new revision of its own global model goes up as a local model under the revision's number, the very bytes
//! that its agents get; what the aggregator above makes of all its edges comes back and is kept. The way up has a
//! link, a session and a thread of its own: a cloud that is out of reach holds nothing up on the ground.
//!
//! | in the folder `upstream` of the service's own | |
//! |---|---|
//! | `global/` | every revision of the global model above that came back |
//! | `global.ply` | the newest one, for viewers |

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, Sender, TryRecvError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use cosurf_link::{
    Credentials, Identity, InboxLimits, ModelKey, ModelStore, MqttConfig, MqttTransport, Node, NodeEvent,
    Offer, StoreError, Transport, body_to_model,
};
use cosurf_scene::bytes::format_bytes;
use cosurf_scene::ply;
use cosurf_wire::{DeviceId, ModelHeader, ModelKind, RefusalReason};
use serde::Serialize;

use super::error::ServiceError;
use super::folder::{global_ply, global_store};

/// Longest wait for something to hear before orders are looked at.
const LOOK_UP: Duration = Duration::from_millis(50);

/// What the way up tells its owner.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum UpstreamEvent {
    /// The link to the aggregator above stands (again).
    UpstreamConnected,
    /// It does not stand and is tried again.
    UpstreamDisconnected {
        /// Failed attempts since it last stood, from 1.
        attempt: u32,
        /// One line.
        reason: String,
    },
    /// A revision is safe on the disk above.
    SentUp {
        /// The revision.
        revision: u64,
        /// Bytes sent for it, resends included.
        bytes_sent: u64,
    },
    /// The aggregator above refuses a revision.
    RefusedAbove {
        /// The revision.
        revision: u64,
        /// Why.
        reason: RefusalReason,
    },
    /// A revision of the global model above is safe on the disk here.
    CameDown {
        /// The revision.
        revision: u64,
        /// Splats of it.
        splats: u32,
    },
    /// A model could not be read or written here.
    UpstreamDiskFailed {
        /// One line.
        reason: String,
    },
}

impl fmt::Display for UpstreamEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UpstreamConnected => write!(f, "upstream: connected"),
            Self::UpstreamDisconnected { reason, .. } | Self::UpstreamDiskFailed { reason } => {
                write!(f, "upstream: {reason}")
            }
            Self::SentUp { revision, bytes_sent } => {
                write!(f, "upstream: revision {revision} is there, {} sent", format_bytes(*bytes_sent))
            }
            Self::RefusedAbove { revision, reason } => {
                write!(f, "upstream: revision {revision} is refused: {reason}")
            }
            Self::CameDown { revision, splats } => {
                write!(f, "upstream: its revision {revision} came, {splats} splats")
            }
        }
    }
}

/// The side of the link that an edge has, to be given a transport and the time again and again.
#[derive(Debug)]
pub(crate) struct UpstreamNode {
    node: Node,
    device: DeviceId,
    /// Own revisions.
    own: ModelStore,
    above: ModelStore,
    folder: PathBuf,
}

impl UpstreamNode {
    /// For the service with this folder.
    pub(crate) fn open(
        identity: Identity,
        credentials: Credentials,
        service: &Path,
        limits: InboxLimits,
    ) -> Result<Self, StoreError> {
        let folder = service.join("upstream");
        let (own, _) = ModelStore::open(&global_store(service))?;
        let (above, known) = ModelStore::open(&global_store(&folder))?;
        let mut node = Node::new(identity, limits, &known);
        node.believe(credentials);
        Ok(Self { node, device: identity.device, own, above, folder })
    }

    /// Begins to send a revision of the service's global model.
    pub(crate) fn send(&mut self, revision: &ModelHeader) -> Result<(), ServiceError> {
        let (header, body) = self.own.get(ModelKey::from(revision))?;
        let offer = Offer::from_body(self.device, header.model, ModelKind::Local, header.views, body)?;
        self.node.upload(offer);
        Ok(())
    }

    /// Hears and says what there is, waiting at most `wait` for something to hear.
    pub(crate) fn step<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
    ) -> Option<UpstreamEvent> {
        match self.node.step(transport, now, wait)? {
            NodeEvent::Connected => Some(UpstreamEvent::UpstreamConnected),
            NodeEvent::Disconnected { attempt, reason } => {
                Some(UpstreamEvent::UpstreamDisconnected { attempt, reason })
            }
            NodeEvent::Uploaded(key, progress) => {
                Some(UpstreamEvent::SentUp { revision: key.model.0, bytes_sent: progress.bytes_sent })
            }
            NodeEvent::UploadRefused { key, reason, .. } => {
                Some(UpstreamEvent::RefusedAbove { revision: key.model.0, reason })
            }
            // Kept before the last stop.
            NodeEvent::Known(header) => Some(came_down(&header)),
            NodeEvent::Store { header, body } => Some(self.store(header, &body)),
            _ => None,
        }
    }

    fn store(&mut self, header: ModelHeader, body: &[u8]) -> UpstreamEvent {
        let key = ModelKey::from(header);
        match self.keep(&header, body) {
            Ok(()) => {
                self.node.stored(key);
                came_down(&header)
            }
            Err(error) => {
                self.node.store_failed(key);
                UpstreamEvent::UpstreamDiskFailed { reason: format!("model {key} is not stored: {error}") }
            }
        }
    }

    fn keep(&self, header: &ModelHeader, body: &[u8]) -> Result<(), ServiceError> {
        let model = body_to_model(body)?;
        ply::write(&global_ply(&self.folder), &model.splats)?;
        Ok(self.above.put(header, body)?)
    }
}

fn came_down(header: &ModelHeader) -> UpstreamEvent {
    UpstreamEvent::CameDown { revision: header.model.0, splats: header.splats }
}

/// A way up on a thread of its own. Dropping it ends it.
#[derive(Debug)]
pub(crate) struct Upstream {
    revisions: Option<Sender<ModelHeader>>,
    thread: Option<JoinHandle<()>>,
}

impl Upstream {
    /// Starts to speak with the aggregator above; `now` is time since any moment.
    pub(crate) fn start(
        mut node: UpstreamNode,
        link: MqttConfig,
        now: impl Fn() -> Duration + Send + 'static,
        say: impl Fn(UpstreamEvent) + Send + 'static,
    ) -> Self {
        let (revisions, queue) = mpsc::channel();
        let thread = thread::spawn(move || {
            let mut transport = MqttTransport::start(link);
            loop {
                match queue.try_recv() {
                    Ok(revision) => {
                        if let Err(error) = node.send(&revision) {
                            say(UpstreamEvent::UpstreamDiskFailed { reason: error.to_string() });
                        }
                    }
                    Err(TryRecvError::Empty) => {}
                    Err(TryRecvError::Disconnected) => return,
                }
                if let Some(event) = node.step(&mut transport, &now, LOOK_UP) {
                    say(event);
                }
            }
        });
        Self { revisions: Some(revisions), thread: Some(thread) }
    }

    /// Sends a revision of the service's own global model, safe on its disk.
    pub(crate) fn send(&self, revision: ModelHeader) {
        if let Some(revisions) = &self.revisions {
            let _ = revisions.send(revision); // fails only where the thread has died of a defect
        }
    }
}

impl Drop for Upstream {
    fn drop(&mut self) {
        self.revisions = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests;
