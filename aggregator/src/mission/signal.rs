//! The events of a mission, from all of its threads.

use super::agents::ProcessEvent;
use crate::service::{ServiceEvent, UpstreamEvent};

/// An event of a mission.
pub(crate) enum Signal {
    /// An event of an agent.
    Agent(ProcessEvent),
    /// An event of an aggregator.
    Service {
        /// The aggregator's post: 0 for the root, `1 + i` for edge `i`.
        post: usize,
        /// What happened.
        event: ServiceEvent,
    },
    /// An event of an edge's upstream link.
    Upstream {
        /// Index of the edge.
        edge: usize,
        /// What happened.
        event: UpstreamEvent,
    },
}
