//! The outgoing messages of a node.

use std::time::Duration;

use super::asking::Asking;
use super::event::NodeEvent;
use super::planning::Planning;
use super::pledge::Pledge;
use super::state::Node;
use crate::inbox::InboxAction;
use crate::transport::{Outgoing, PublishError, Transport};
use crate::uploader::Uploader;

/// Maximum number of messages that the node sends before it polls for incoming ones: half a window of chunks.
const BURST: usize = 16;
/// Delay before the node retries a transport that was busy.
const BUSY_WAIT: Duration = Duration::from_millis(2);

impl Node {
    /// Time at which [`Self::step`] next has something to do if no message arrives before. `None` if nothing
    /// is scheduled or the transport is not connected.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let uploads = self.uploaders.iter().filter_map(Uploader::next_wakeup);
        uploads
            .chain(self.inbox.next_wakeup())
            .chain(self.lost.next_wakeup())
            .chain(self.confirming.next_wakeup())
            .chain(self.pledge.as_ref().and_then(Pledge::next_wakeup))
            .chain(self.planning.as_ref().and_then(Planning::next_wakeup))
            .chain(self.asking.as_ref().and_then(Asking::next_wakeup))
            .min()
            .filter(|_| self.is_connected)
    }

    /// Sends the messages that are due, at most [`BURST`]. Returns the time until the next message is due.
    pub(super) fn send<T: Transport>(&mut self, transport: &mut T) -> Duration {
        if !self.is_connected {
            return Duration::MAX;
        }
        let mut takes_chunks = true;
        for _ in 0..BURST {
            let Some(message) = self.next_message(takes_chunks) else {
                let wakeup = self.next_wakeup().unwrap_or(Duration::MAX).saturating_sub(self.now);
                return if takes_chunks { wakeup } else { BUSY_WAIT };
            };
            match transport.publish(&message) {
                Ok(()) => {}
                Err(PublishError::Busy) if message.is_chunk() => {
                    self.waiting_chunk = Some(message);
                    takes_chunks = false;
                }
                Err(PublishError::Busy) => {
                    self.waiting_control = Some(message);
                    return BUSY_WAIT;
                }
                Err(error @ PublishError::TooLarge { max_bytes, .. }) => self.on_too_large(error, max_bytes),
            }
        }
        if takes_chunks { Duration::ZERO } else { BUSY_WAIT }
    }

    fn next_message(&mut self, takes_chunks: bool) -> Option<Outgoing> {
        let waiting = self.waiting_control.take().or_else(|| self.waiting_chunk.take_if(|_| takes_chunks));
        // While a chunk waits, no further one is made.
        waiting.or_else(|| self.next_sealed(takes_chunks))
    }

    fn next_sealed(&mut self, takes_chunks: bool) -> Option<Outgoing> {
        if self.asking.as_mut().is_some_and(|asking| asking.is_due(self.now)) {
            self.birth = Some(self.identity.state_message(true));
        }
        let retained = self.birth.take().or_else(|| self.next_retained());
        let next = retained.or_else(|| self.next_outgoing(takes_chunks))?;
        let key = self.inbox.credentials().key.as_ref();
        Some(self.sealer.seal(&self.identity, key, next))
    }

    /// A refusal of a header of the version before, the deletion of a retained message, or the announcement of this device's flight.
    fn next_retained(&mut self) -> Option<Outgoing> {
        if let Some(refusal) = self.refusals_before.pop_front() {
            return Some(refusal);
        }
        if let Some(topic) = self.cleared.pop_front() {
            return Some(Outgoing::clear(&self.identity.site, topic));
        }
        std::mem::take(&mut self.is_flight_due).then(|| self.flight.clone()).flatten()
    }

    fn next_outgoing(&mut self, takes_chunks: bool) -> Option<Outgoing> {
        while let Some(action) = self.inbox.next(self.now) {
            match action {
                InboxAction::Publish(message) => return Some(message),
                InboxAction::Store { header, body } => {
                    self.events.push_back(NodeEvent::Store { header, body });
                }
            }
        }
        let now = self.now;
        if let Some(request) = self.lost.next(now, &self.identity.site, &self.births) {
            return Some(request);
        }
        if let Some(flights) = self.next_of_flights() {
            return Some(flights);
        }
        let (site, frame) = (self.identity.site, self.inbox.credentials().frame);
        if let Some(plan) = self.planning.as_mut().and_then(|planning| planning.next(now, &site, frame)) {
            return Some(plan);
        }
        let next = |uploader: &mut Uploader| match takes_chunks {
            true => uploader.next(now),
            false => uploader.next_control(now),
        };
        let message = self.uploaders.iter_mut().find_map(next);
        for uploader in &mut self.uploaders {
            let key = uploader.key();
            let event = |offers| NodeEvent::Unanswered { key, offers };
            self.events.extend(uploader.take_unanswered().map(event));
        }
        let mut tiles = self.uploaders.iter_mut().filter(|uploader| uploader.device().is_some());
        if tiles.any(Uploader::take_ignored) {
            self.uploaders.iter_mut().for_each(|uploader| uploader.offer_again(now));
        }
        self.uploaders.retain(|uploader| !uploader.is_over());
        message
    }

    /// A part of the list of confirmed flights, or the pledge of this device's own.
    fn next_of_flights(&mut self) -> Option<Outgoing> {
        let (now, site) = (self.now, self.identity.site);
        let part = self.confirming.next(now, &site);
        part.or_else(|| self.pledge.as_mut()?.next(now, &site))
    }

    /// A message was too large for the link. Chunks are the largest messages, so all offers are repeated with
    /// smaller chunks. An upload whose chunks would become too small is dropped.
    fn on_too_large(&mut self, error: PublishError, max_bytes: usize) {
        let now = self.now;
        let before = self.uploaders.len();
        self.uploaders.retain_mut(|uploader| uploader.shrink_chunks(now, max_bytes));
        if self.uploaders.len() < before || before == 0 {
            self.events.push_back(NodeEvent::LinkTooNarrow(error));
        }
    }
}
