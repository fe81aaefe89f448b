//! A participant: its inbox, its uploads, its birth notice, on one transport.

use std::ops::ControlFlow;
use std::time::Duration;

use cosurf_wire::{DeviceId, ModelHeader, RefusalReason, SiteId, State, TileId};

use crate::{Inbox, InboxLimits, ModelKey, Offer, Transport, UploadProgress};

/// Who takes part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// In which site.
    pub site: SiteId,
    /// Under which name; two at once under one name throw each other out.
    pub device: DeviceId,
    /// Number of this session, never used twice (seconds since 1970 at start will do).
    pub session: u64,
    /// On which side.
    pub role: Role,
}

/// On which side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Sends local models, receives global ones.
    Device,
    /// Receives local models, sends global ones.
    Aggregator,
}

/// What a node tells its owner.
#[derive(Clone, Debug)]
pub enum NodeEvent {
    /// The transport is connected (again).
    Connected,
    /// The transport is not connected and tries again.
    Disconnected {
        /// Failed attempts since it last stood, from 1.
        attempt: u32,
        /// One line to show.
        reason: String,
    },
    /// A device is born or has died.
    State(State),
    /// A header was accepted; its body is being fetched.
    Receiving(ModelHeader),
    /// A whole, verified body. Write it, sync it, rename it, then call [`Node::stored`]; or
    /// [`Node::store_failed`], or [`Node::refuse`]. Until then its sender waits.
    Store {
        /// What was announced, and holds.
        header: ModelHeader,
        /// For [`crate::body_to_model`].
        body: Vec<u8>,
    },
    /// Something was heard and thrown away; worth a line in a log.
    Ignored {
        /// Under which topic.
        topic: String,
        /// Why.
        reason: String,
    },
    /// An upload got on.
    Progress(ModelKey, UploadProgress),
    /// Every receiver has the model on its disk.
    Uploaded(ModelKey, UploadProgress),
    /// A receiver refuses the model; for good, unless the reason [`RefusalReason::is_passing`].
    UploadRefused {
        /// Which model.
        key: ModelKey,
        /// Who refuses: a device, or (for a local model) the aggregator, named as the model's own device.
        by: DeviceId,
        /// Why.
        reason: RefusalReason,
    },
}

/// A participant. Give it a transport and the time, again and again.
#[derive(Debug)]
pub struct Node {
    identity: Identity,
}

impl Node {
    /// A node that holds the models of `stored` already (their headers, as the store knows them).
    pub fn new(identity: Identity, _limits: InboxLimits, _stored: &[ModelHeader]) -> Self {
        Self { identity }
    }

    /// Begins to offer a device's own model to the aggregator.
    pub fn upload(&mut self, _offer: Offer) {
        unimplemented!("lands soon")
    }

    /// Begins to offer a global model to `receivers`, in place of any older revision.
    pub fn broadcast(&mut self, _tile: TileId, _offer: Offer, _receivers: &[DeviceId]) {
        unimplemented!("lands soon")
    }

    /// The inbox, to answer [`NodeEvent::Store`].
    pub fn inbox(&mut self) -> &mut Inbox {
        unimplemented!("lands soon {:?}", self.identity)
    }

    /// Hears, answers and sends what there is, waiting at most `wait` for something to hear; returns what
    /// the owner must know, or `None` where there is nothing.
    pub fn step<T: Transport>(
        &mut self,
        _transport: &mut T,
        _now: impl Fn() -> Duration,
        _wait: Duration,
    ) -> Option<NodeEvent> {
        unimplemented!("lands soon")
    }

    /// [`Self::step`] until `on_event` breaks; it is called with `None` at least every `wait`.
    pub fn serve<T: Transport, B>(
        &mut self,
        _transport: &mut T,
        _now: impl Fn() -> Duration,
        _wait: Duration,
        _on_event: impl FnMut(&mut Self, Option<NodeEvent>) -> ControlFlow<B>,
    ) -> B {
        unimplemented!("lands soon")
    }
}

/// Uploads one model and returns when the aggregator has it on its disk, or why it refuses for good.
/// Everything else that happens is told to `on_event`, which must answer [`NodeEvent::Store`].
pub fn upload_blocking<T: Transport>(
    _node: &mut Node,
    _transport: &mut T,
    _offer: Offer,
    _now: impl Fn() -> Duration,
    _on_event: impl FnMut(&mut Node, NodeEvent),
) -> Result<UploadProgress, RefusalReason> {
    unimplemented!("lands soon")
}
