//! Writes the events of a node to the log.

use cosurf_wire::ModelHeader;
use tracing::{debug, trace};

use super::event::NodeEvent;
use crate::key::ModelKey;

/// Logs an event before the caller gets it.
pub(super) fn log(event: &NodeEvent) {
    match event {
        NodeEvent::Connected => debug!("connected"),
        NodeEvent::Disconnected { attempt, reason } => debug!(attempt, reason, "disconnected"),
        NodeEvent::State(state) => debug!(device = %state.device, alive = state.alive, "session"),
        NodeEvent::Flight { device, cameras, .. } => debug!(%device, cameras = cameras.len(), "flight"),
        NodeEvent::ConfirmedFlights(flights) => debug!(flights = flights.len(), "confirmed flights"),
        NodeEvent::FlightPledged { device, session, .. } => debug!(%device, session, "flight pledged"),
        NodeEvent::SameName(device) => debug!(%device, "two participants use the same name"),
        NodeEvent::Receiving(header) => log_header(header, "receive"),
        NodeEvent::Known(header) => log_header(header, "known already"),
        NodeEvent::Store { header, .. } => log_header(header, "store"),
        NodeEvent::Refused { key, reason } => debug!(model = %key, %reason, "refuse"),
        NodeEvent::Ignored { topic, reason, .. } => debug!(topic, reason, "ignored message"),
        NodeEvent::OtherVersion { source, version } => debug!(?source, version, "message of another version"),
        NodeEvent::Unanswered { key, offers } => debug!(model = %key, offers, "no reply"),
        NodeEvent::Progress(key, progress) => {
            trace!(model = %key, received = progress.chunks_received, of = progress.chunks, "chunks");
        }
        NodeEvent::Uploaded(key, progress) => {
            debug!(model = %key, bytes = progress.bytes_sent, "uploaded");
        }
        NodeEvent::OlderSession { sender, heard } => debug!(%sender, heard, "older session"),
        NodeEvent::Denied(reason) => debug!(reason, "the broker does not take a message"),
        NodeEvent::AskedAgain { key, by } => debug!(model = %key, %by, "asked for again"),
        NodeEvent::UploadRefused { key, by, reason } => debug!(model = %key, %by, %reason, "upload refused"),
        NodeEvent::TooManyDevices { device, devices_max } => debug!(%device, devices_max, "too many devices"),
        NodeEvent::LinkTooNarrow(error) => debug!(%error, "link too narrow"),
    }
}

fn log_header(header: &ModelHeader, message: &str) {
    debug!(model = %ModelKey::from(header), bytes = header.body_bytes, splats = header.splats, "{message}");
}
