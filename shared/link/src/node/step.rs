//! Runs a node: [`Node::step`] sends and receives once, [`Node::serve`] does so repeatedly.

use std::ops::ControlFlow;
use std::time::Duration;

use super::event::NodeEvent;
use super::state::Node;
use crate::transport::Transport;

impl Node {
    /// Hears, answers and sends what there is, waiting at most `wait` for something to hear. Returns what
    /// the owner must know; `None` says nothing about whether more is to be done.
    pub fn step<T: Transport>(
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

    /// Calls [`Self::step`] until `on_event` breaks; it is called with `None` at least every `wait`.
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
