//! What a node tells its owner.

use std::sync::Arc;

use cosurf_scene::Camera;
use cosurf_wire::{DeviceId, ModelHeader, RefusalReason, State};

use crate::key::ModelKey;
use crate::transport::PublishError;
use crate::uploader::UploadProgress;

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
    /// What another device has photographed, in this one's frame.
    Flight(DeviceId, Vec<Camera>),
    /// Two participants take turns under one name; each throws the other out.
    SameName(DeviceId),
    /// A header was accepted; its body is being fetched.
    Receiving(ModelHeader),
    /// A model was announced that is stored already, in this session or an earlier one.
    Known(ModelHeader),
    /// A whole, verified body. Write it, sync it, rename it, then call [`super::Node::stored`]; or
    /// [`super::Node::store_failed`], or [`super::Node::refuse`]. Until then its sender waits.
    Store {
        /// What was announced, and holds.
        header: ModelHeader,
        /// For [`crate::body_to_model`].
        body: Arc<Vec<u8>>,
    },
    /// A model from outside was refused; its sender has been told.
    Refused {
        /// Which.
        key: ModelKey,
        /// Why.
        reason: RefusalReason,
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
    /// Every receiver that is waited for has the model on its disk.
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
    /// The link takes no messages of a size that makes sense.
    LinkTooNarrow(PublishError),
}
