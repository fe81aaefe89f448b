//! A broker in memory on virtual time, with faults from a seed.

use std::time::Duration;

use crate::{PublishError, Transport, TransportEvent};

/// What goes wrong, as probabilities 0 to 1 per delivery.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Faults {
    /// A message is lost.
    pub loss: f64,
    /// A message comes twice.
    pub duplication: f64,
    /// A message has one byte changed.
    pub corruption: f64,
    /// A message takes up to this long, evenly; what is sent later may come earlier.
    pub delay_max: Duration,
}

/// The broker.
#[derive(Clone, Debug)]
pub struct MemoryNetwork {}

impl MemoryNetwork {
    /// The same seed, the same faults.
    pub fn new(_seed: u64, _faults: Faults) -> Self {
        Self {}
    }

    /// Joins a client.
    pub fn join(&self) -> MemoryTransport {
        MemoryTransport {}
    }

    /// Virtual time.
    pub fn now(&self) -> Duration {
        unimplemented!("lands soon")
    }

    /// Moves virtual time.
    pub fn advance(&self, _by: Duration) {
        unimplemented!("lands soon")
    }
}

/// A client of a [`MemoryNetwork`]; `poll` never waits.
#[derive(Debug)]
pub struct MemoryTransport {}

impl Transport for MemoryTransport {
    fn subscribe(&mut self, _filter: &str) {}

    fn publish(&mut self, _topic: &str, _payload: &[u8], _retain: bool) -> Result<(), PublishError> {
        unimplemented!("lands soon")
    }

    fn poll(&mut self, _timeout: Duration) -> Option<TransportEvent> {
        unimplemented!("lands soon")
    }
}
