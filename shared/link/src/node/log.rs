//! Writes the events of a node to the log.

use std::time::Duration;

use cosurf_wire::ModelHeader;
use tracing::{debug, trace};

use super::event::NodeEvent;
use crate::key::ModelKey;

/// Events that are logged one by one in a second. A flood of messages must not fill the disk with lines about them.
const LINES_PER_S: u64 = 50;

/// The log of a node's events, of which it leaves out those beyond [`LINES_PER_S`].
#[derive(Debug, Default)]
pub(super) struct Log {
    /// The second that is being counted, and its events so far.
    second: u64,
    events: u64,
}

impl Log {
    /// Logs an event before the caller gets it.
    pub(super) fn write(&mut self, now: Duration, event: &NodeEvent) {
        let (is_written, left_out) = self.admit(now.as_secs());
        if left_out > 0 {
            debug!(left_out, "more events than are logged");
        }
        if is_written {
            write(event);
        }
    }

    /// Counts an event. Returns whether it is logged, and how many events of the second before were left out.
    fn admit(&mut self, second: u64) -> (bool, u64) {
        let mut left_out = 0;
        if second != self.second {
            left_out = self.events.saturating_sub(LINES_PER_S);
            (self.second, self.events) = (second, 0);
        }
        self.events += 1;
        (self.events <= LINES_PER_S, left_out)
    }
}

fn write(event: &NodeEvent) {
    match event {
        NodeEvent::Connected => debug!("connected"),
        NodeEvent::Disconnected { attempt, reason } => debug!(attempt, reason, "disconnected"),
        NodeEvent::State(state) => debug!(device = %state.device, alive = state.alive, "session"),
        NodeEvent::Flight { device, cameras, .. } => debug!(%device, cameras = cameras.len(), "flight"),
        NodeEvent::ConfirmedFlights(flights) => debug!(flights = flights.len(), "confirmed flights"),
        NodeEvent::FlightPledged { device, session, .. } => debug!(%device, session, "flight pledged"),
        NodeEvent::Plan { frame, cell } => {
            debug!(%frame, corners = cell.as_ref().map_or(0, |cell| cell.corners.len()), "plan");
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_events_gives_a_few_lines_and_their_number() {
        let mut log = Log::default();
        let admitted: Vec<(bool, u64)> = (0..1000u64).map(|i| log.admit(7 + i / 400)).collect();
        let lines = admitted.iter().filter(|(is_written, _)| *is_written).count() as u64;
        assert_eq!(lines, 3 * LINES_PER_S);
        let left_out: u64 = admitted.iter().map(|(_, left_out)| left_out).sum();
        assert_eq!(left_out, 2 * (400 - LINES_PER_S), "the last 200 are told once their second is over");
    }
}
