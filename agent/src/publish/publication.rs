//! What the agent publishes, and how it shares the ground with other devices.

use std::path::Path;
use std::time::Duration;

use cosurf_link::{Credentials, Identity};
use cosurf_scene::{Base, Camera, Splats};

/// What to send and what to wait for.
pub struct Publication<'a> {
    /// The sender.
    pub identity: Identity,
    /// The trained model.
    pub splats: &'a Splats,
    /// The training cameras.
    pub cameras: &'a [Camera],
    /// The base that is sent first. Without one the most important splats are sent first.
    pub base: Option<&'a Base>,
    /// Set if the agent drops splats of ground that other devices observed better.
    pub sharing: Option<Sharing<'a>>,
    /// The model's frame, the key that signs it, and whose global models are accepted.
    pub credentials: &'a Credentials,
    /// The agent's folder.
    pub out: &'a Path,
    /// Whether to wait for a global model.
    pub wait_global: bool,
    /// Limit on the bytes of an incoming global model.
    pub inbox_bytes: u64,
    /// How long the connection stays open for its last messages.
    pub flush_time: Duration,
}

/// How ground is shared with other devices; see [`crate::flights`].
#[derive(Clone, Copy)]
pub struct Sharing<'a> {
    /// The cameras that this device announced with [`announce_flight`](super::announce_flight).
    pub flight: &'a [Camera],
    /// After this much time without a new flight all flights are known.
    pub quiet: Duration,
    /// CPU threads, at least 1.
    pub threads: usize,
}
