//! The link from an edge aggregator to the aggregator above it (its cloud). For the aggregator above, the edge is a
//! device.
//!
//! Each new revision of the edge's global model is uploaded as a local model with the revision's number. The aggregator
//! above merges the models of all edges. Its global model comes back and is stored; [`super::above`] hands it on. The upstream link has a connection and a thread of its own, so an unreachable cloud does not delay
//! the edge's service.
//!
//! | in `upstream/` of the service's folder | |
//! |---|---|
//! | `global/` | every received revision of the global model above |
//! | `global.ply` | the newest of these, for viewers |

use std::fmt;
use std::path::Path;
use std::sync::mpsc::{self, Sender, TryRecvError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use cosurf_link::{
    Complete, Credentials, Identity, InboxLimits, ModelKey, ModelStore, MqttConfig, MqttTransport, Node,
    NodeEvent, Offer, ReceiveError, Received, StoreError, Transport,
};
use cosurf_scene::bytes::format_bytes;
use cosurf_wire::{DeviceId, ModelHeader, ModelKind, RefusalReason};
use serde::Serialize;

use super::above::{AboveLink, FromAbove};
use super::control::BROKER_ATTEMPTS_MAX;
use super::error::ServiceError;
use super::folder::{global_ply, global_store};
use cosurf_contract::counted;

/// Longest wait for a message before new revisions are checked for.
const LISTEN: Duration = Duration::from_millis(50);

/// What the upstream link reports.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum UpstreamEvent {
    /// The link to the aggregator above is up (again).
    UpstreamConnected,
    /// The link to the aggregator above is down; the edge keeps trying.
    UpstreamDisconnected {
        /// Number of failed attempts since the link was last up, from 1.
        attempt: u32,
        /// The reason, one line.
        reason: String,
    },
    /// The broker above does not take a message.
    DeniedAbove {
        /// The reason, one line.
        reason: String,
    },
    /// The aggregator above has stored a revision of the edge.
    SentUp {
        /// The revision.
        revision: u64,
        /// Bytes sent for this revision, resends included.
        bytes_sent: u64,
    },
    /// The aggregator above refuses a revision of the edge.
    RefusedAbove {
        /// The revision.
        revision: u64,
        /// The reason.
        reason: RefusalReason,
    },
    /// The edge has stored a revision of the global model above.
    CameDown {
        /// The revision.
        revision: u64,
        /// Number of splats of this revision that are meant for the edge.
        splats: u64,
    },
    /// The edge refused a revision of the global model above.
    NotReceived {
        /// The revision.
        revision: u64,
        /// The reason.
        reason: RefusalReason,
    },
    /// A model could not be read from the edge's disk or written to it.
    UpstreamDiskFailed {
        /// The reason, one line.
        reason: String,
    },
}

impl fmt::Display for UpstreamEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UpstreamConnected => write!(f, "upstream: connected"),
            Self::UpstreamDisconnected { attempt, reason } => {
                write!(f, "upstream: {reason}; trying again (attempt {attempt})")
            }
            Self::UpstreamDiskFailed { reason } | Self::DeniedAbove { reason } => {
                write!(f, "upstream: {reason}")
            }
            Self::SentUp { revision, bytes_sent } => {
                write!(f, "upstream: revision {revision} is delivered, {} sent", format_bytes(*bytes_sent))
            }
            Self::RefusedAbove { revision, reason } => {
                write!(f, "upstream: revision {revision} is refused: {reason}")
            }
            Self::NotReceived { revision, reason } => {
                write!(f, "upstream: the global model above, revision {revision}, is not received: {reason}")
            }
            Self::CameDown { revision, splats } => {
                let splats = counted(*splats, "splat");
                write!(f, "upstream: global model received, revision {revision}: {splats}")
            }
        }
    }
}

/// The edge's side of the link. The caller must call `step` again and again, with a transport and the time.
#[derive(Debug)]
pub(crate) struct UpstreamNode {
    node: Node,
    device: DeviceId,
    /// Revisions of the edge's own global model.
    own: ModelStore,
    /// Revisions received of the global model above.
    above: Received,
    /// Tells the edge's service.
    tell: Sender<FromAbove>,
}

impl UpstreamNode {
    /// Opens the link of the service whose folder is `service`. Also returns the service's end of the link.
    pub(crate) fn open(
        identity: Identity,
        credentials: Credentials,
        service: &Path,
        limits: InboxLimits,
    ) -> Result<(Self, AboveLink), StoreError> {
        let folder = service.join("upstream");
        let (own, _) = ModelStore::open(&global_store(service))?;
        let (above, known) = Received::open(identity.device, &global_store(&folder), global_ply(&folder))?;
        let mut node = Node::new(identity, limits, &known);
        node.set_credentials(credentials);
        node.keep_arrived(&global_store(&folder))?;
        let (tell, news) = mpsc::channel();
        let upstream = Self { node, device: identity.device, own, above, tell };
        if let Some(header) = upstream.above.newest_at_start()? {
            upstream.tell(FromAbove::Had(header));
        }
        let store = upstream.above.store().clone();
        Ok((upstream, AboveLink { device: identity.device, store, news }))
    }

    fn tell(&self, news: FromAbove) {
        let _ = self.tell.send(news); // fails only if the service has ended
    }

    /// Begins to upload a revision of the service's global model.
    pub(crate) fn send(&mut self, revision: &ModelHeader) -> Result<(), ServiceError> {
        let (header, body) = self.own.get(ModelKey::from(revision))?;
        let offer = Offer::from_body(self.device, header.model, ModelKind::Local, header.views, body)?;
        self.node.upload(offer);
        Ok(())
    }

    /// Sends what is due and handles what arrives, waiting at most `wait` for a message.
    pub(crate) fn step<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
    ) -> Option<UpstreamEvent> {
        if let Some(damaged) = self.above.take_damaged() {
            return Some(UpstreamEvent::UpstreamDiskFailed { reason: damaged.to_string() });
        }
        match self.node.step(transport, now, wait)? {
            NodeEvent::Connected => Some(UpstreamEvent::UpstreamConnected),
            NodeEvent::Disconnected { attempt, reason } => {
                if attempt >= BROKER_ATTEMPTS_MAX {
                    self.tell(FromAbove::Nothing);
                }
                Some(UpstreamEvent::UpstreamDisconnected { attempt, reason })
            }
            NodeEvent::Denied(reason) => Some(UpstreamEvent::DeniedAbove { reason }),
            NodeEvent::Uploaded(key, progress) => {
                self.tell(FromAbove::HasOwn);
                Some(UpstreamEvent::SentUp { revision: key.model.0, bytes_sent: progress.bytes_sent })
            }
            NodeEvent::UploadRefused { key, reason, .. } => {
                if matches!(reason, RefusalReason::NumberTaken | RefusalReason::Replayed)
                    && self.node.renumber(key).is_some()
                {
                    return None;
                }
                if !reason.is_temporary() {
                    self.tell(FromAbove::Nothing);
                }
                Some(UpstreamEvent::RefusedAbove { revision: key.model.0, reason })
            }
            // The edge has stored this revision already, for example before a restart.
            NodeEvent::Known(header) => {
                let known = self.above.known(&mut self.node, header);
                self.came_down(header.into(), known)
            }
            NodeEvent::Store { header, body } => {
                let kept = self.above.take(&mut self.node, header, &body);
                self.came_down(header.into(), kept)
            }
            NodeEvent::Refused { key, reason } if !reason.is_temporary() => {
                self.tell(FromAbove::Nothing);
                let revision = self.above.revision().filter(|_| key.model.is_tile()).unwrap_or(key.model);
                Some(UpstreamEvent::NotReceived { revision: revision.0, reason })
            }
            _ => None,
        }
    }

    fn came_down(
        &self,
        key: ModelKey,
        received: Result<Option<Complete>, ReceiveError>,
    ) -> Option<UpstreamEvent> {
        match received {
            Ok(complete) => complete.map(|Complete { revision, splats }| {
                self.above.newest().into_iter().for_each(|header| self.tell(FromAbove::Came(header)));
                UpstreamEvent::CameDown { revision: revision.0, splats: splats as u64 }
            }),
            Err(error) => {
                let reason = format!("model {key} is not stored: {error}");
                Some(UpstreamEvent::UpstreamDiskFailed { reason })
            }
        }
    }
}

/// An upstream link on its own thread. Dropping it ends the thread.
#[derive(Debug)]
pub(crate) struct Upstream {
    revisions: Option<Sender<ModelHeader>>,
    thread: Option<JoinHandle<()>>,
}

impl Upstream {
    /// Starts the link to the aggregator above. `now` returns the time since any fixed moment.
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
                if let Some(event) = node.step(&mut transport, &now, LISTEN) {
                    say(event);
                }
            }
        });
        Self { revisions: Some(revisions), thread: Some(thread) }
    }

    /// Uploads a revision of the service's global model, which must be on the disk already.
    pub(crate) fn send(&self, revision: ModelHeader) {
        if let Some(revisions) = &self.revisions {
            let _ = revisions.send(revision); // fails only if the thread has panicked
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
