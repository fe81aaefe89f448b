//! The events of a node.

use std::collections::BTreeMap;
use std::sync::Arc;

use cosurf_scene::Camera;
use cosurf_wire::{BodyHash, DeviceId, FrameId, ModelHeader, RefusalReason, State};

use super::planning::PlannedCell;
use crate::key::ModelKey;
use crate::transport::PublishError;
use crate::uploader::UploadProgress;

/// An event that a node reports to its caller.
#[derive(Clone, Debug)]
pub enum NodeEvent {
    /// The transport is connected (again).
    Connected,
    /// The transport is not connected, and retries by itself.
    Disconnected {
        /// Number of failures since the last connection, from 1. The loss of the connection counts too.
        attempt: u32,
        /// One line with the address, the error and the attempt.
        reason: String,
    },
    /// A device has started or ended a session.
    State(State),
    /// Another device's flight. It counts only if the aggregator has confirmed it, if this node has a list of trusted keys.
    Flight {
        /// The other device.
        device: DeviceId,
        /// The cameras, in the world frame that this node uses.
        cameras: Vec<Camera>,
        /// Hash of the encoded cameras.
        cameras_blake3: BodyHash,
    },
    /// The aggregator tells which flights count: devices, and the hashes of their encoded cameras. For devices with a flight
    /// and a list of trusted keys. Each list replaces the one before.
    ConfirmedFlights(BTreeMap<DeviceId, BodyHash>),
    /// A device has pledged to this session of the aggregator that it will send a model of its newest flight.
    FlightPledged {
        /// The device.
        device: DeviceId,
        /// Number of the device's session.
        session: u64,
        /// Hash of the encoded cameras.
        cameras_blake3: BodyHash,
    },
    /// The aggregator's answer to a device that asked for its cell of the site's plan, for this session.
    Plan {
        /// The world frame of the site.
        frame: FrameId,
        /// The cell; `None` if the plan has none for this device.
        cell: Option<PlannedCell>,
    },
    /// Two participants use the same name. Most brokers keep disconnecting one of them.
    SameName(DeviceId),
    /// The node accepted an offer, and requests the chunks of the body.
    Receiving(ModelHeader),
    /// The offered model is already stored, from this session or an earlier one.
    Known(ModelHeader),
    /// A complete and checked body. The caller must write, sync and rename it and then call
    /// [`super::Node::stored`], or otherwise call [`super::Node::store_failed`] or [`super::Node::refuse`].
    /// Each of these calls sends the reply for which the sender waits.
    Store {
        /// The model's header.
        header: ModelHeader,
        /// The body, for [`crate::body_to_model`].
        body: Arc<Vec<u8>>,
    },
    /// The node refused an offered model, and has told the sender.
    Refused {
        /// The model.
        key: ModelKey,
        /// The reason.
        reason: RefusalReason,
    },
    /// The node dropped an incoming message.
    Ignored {
        /// The participant that the message claims to come from, or else the one that it is for; `None` if the topic does
        /// not tell.
        source: Option<DeviceId>,
        /// The message's topic. Line breaks and other control characters in it are escaped.
        topic: String,
        /// The reason.
        reason: String,
    },
    /// A message of another version arrived. A device of the version before is refused, so that its agent ends.
    OtherVersion {
        /// The participant that the message claims to come from, or else the one that it is for.
        source: Option<DeviceId>,
        /// The other version.
        version: u8,
    },
    /// The aggregator has not replied to the last offers of a device's model.
    Unanswered {
        /// The model.
        key: ModelKey,
        /// Number of offers since the last reply.
        offers: u32,
    },
    /// An offer does not count because it is of a session before one that was heard. Either somebody repeats a recorded one,
    /// or the sender's clock was ahead and its folder is new.
    OlderSession {
        /// The sender.
        sender: DeviceId,
        /// The newest session that was heard.
        heard: u64,
    },
    /// The broker does not take a message. One line with the reason.
    Denied(String),
    /// An upload has progressed.
    Progress(ModelKey, UploadProgress),
    /// Every required receiver has stored the model.
    Uploaded(ModelKey, UploadProgress),
    /// A receiver has lost a model after it had stored it, and gets it again.
    AskedAgain {
        /// The model.
        key: ModelKey,
        /// The device that has lost a global model, or that sends its own model to the aggregator again.
        by: DeviceId,
    },
    /// A receiver refuses the model. The refusal is final unless [`RefusalReason::is_temporary`].
    UploadRefused {
        /// The model.
        key: ModelKey,
        /// For a global model, the device that refuses it. For a local model, the device that offered it,
        /// because the topic of the aggregator's reply names only that device.
        by: DeviceId,
        /// The reason.
        reason: RefusalReason,
    },
    /// A device is one too many: the sessions of further devices are not remembered, and their requests for a global model
    /// are not answered unless the model must reach them. Reported once, and once for each global model.
    TooManyDevices {
        /// The device.
        device: DeviceId,
        /// The limit, see [`super::Node::set_devices_max`].
        devices_max: usize,
    },
    /// The link accepts only messages that are too small for useful chunks. The node has dropped the uploads
    /// that cannot use smaller chunks.
    LinkTooNarrow(PublishError),
}
