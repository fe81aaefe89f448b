//! Runs a node: [`Node::step`] sends and receives once, [`Node::serve`] repeatedly.

use std::ops::ControlFlow;
use std::time::Duration;

use super::event::NodeEvent;
use super::state::Node;
use crate::transport::Transport;

impl Node {
    /// Sends the messages that are due, then waits at most `wait` for a message and handles it. Returns the
    /// next event for the caller. `None` means only that there is no event: messages may still have to be
    /// sent.
    pub fn step<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
    ) -> Option<NodeEvent> {
        let event = self.next_event(transport, now, wait);
        event.iter().for_each(|event| self.log.write(self.now, event));
        event
    }

    fn next_event<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
    ) -> Option<NodeEvent> {
        self.now = now();
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        let wait = wait.min(self.send(transport));
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        if let Some(event) = transport.poll(wait) {
            self.now = now();
            self.receive(event);
        }
        self.events.pop_front()
    }

    /// Calls [`Self::step`] and then `on_event` with the result, until `on_event` breaks. `on_event` is
    /// called at least every `wait`, with `None` if there is no event.
    pub fn serve<T: Transport, B>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
        mut on_event: impl FnMut(&mut Self, Option<NodeEvent>) -> ControlFlow<B>,
    ) -> B {
        loop {
            let event = self.step(transport, &now, wait);
            if let ControlFlow::Break(result) = on_event(self, event) {
                return result;
            }
        }
    }
}
