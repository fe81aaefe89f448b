//! The inputs of [`publish`](super::publish): what the agent publishes, and how it shares ground with other devices.

use std::path::Path;
use std::time::Duration;

use cosurf_link::{Credentials, Identity};
use cosurf_scene::{Base, Camera, LocalFrame, Splats};

use crate::status::StatusBoard;

/// A model to send, and what to wait for afterwards.
pub struct Publication<'a> {
    /// The identity of this device in its current session.
    pub identity: Identity,
    /// The frame of the model and of its cameras.
    pub frame: &'a LocalFrame,
    /// Whether the model lies in the world frame; false if its photographs were posed without GPS and control points.
    pub is_placed: bool,
    /// The trained model.
    pub splats: &'a Splats,
    /// The training cameras, scaled to the picture sizes that training used.
    pub cameras: &'a [Camera],
    /// The base, a small model that stands in for the whole model until all of it has arrived. It is sent first. If it
    /// is `None`, the most important splats are sent first.
    pub base: Option<&'a Base>,
    /// Settings for dropping splats of ground that other devices observed better; `None` sends all splats.
    pub sharing: Option<Sharing<'a>>,
    /// The world frame of the model, the key that signs it, and the keys whose global models are accepted.
    pub credentials: &'a Credentials,
    /// The agent's folder. It keeps the published number and the received global model.
    pub out: &'a Path,
    /// Whether to wait for a global model after the upload.
    pub wait_global: bool,
    /// Limit on the bytes of a received global model; it holds for the encoded and for the decoded model.
    pub inbox_bytes: u64,
    /// How long the connection stays open at the end, so that the last messages are sent.
    pub flush_time: Duration,
    /// The board whose status is told over the link; `None` on lines that are too slow for it.
    pub status: Option<&'a StatusBoard>,
}

/// Settings for dropping splats of ground that other devices own; see [`crate::flights`].
#[derive(Clone, Copy)]
pub struct Sharing<'a> {
    /// The cameras that this device has announced, in the world: those of all its pictures.
    pub flight: &'a [Camera],
    /// All flights count as known once no flight has arrived for this long.
    pub quiet: Duration,
    /// Limit on the devices whose flights count, this one included.
    pub flights_max: usize,
}
