//! What happens in a mission, from all of its threads.

use super::agents::ProcessEvent;
use crate::service::{ServiceEvent, UpstreamEvent};

/// What happens in a mission.
pub(crate) enum Signal {
    /// To an agent.
    Agent(ProcessEvent),
    /// To an aggregator.
    Service {
        /// Its post in the tree.
        post: usize,
        /// What.
        event: ServiceEvent,
    },
    /// On the way up of an edge.
    Upstream {
        /// Its index.
        edge: usize,
        /// What.
        event: UpstreamEvent,
    },
}
