//! What happens in a mission, from all of its threads.

use super::agents::ProcessEvent;
use crate::service::{ServiceEvent, UpstreamEvent};

/// An event of a mission.
pub(crate) enum Signal {
    /// To an agent.
    Agent(ProcessEvent),
    /// To an aggregator.
    Service {
        /// The aggregator's post in the tree.
        post: usize,
        /// What.
        event: ServiceEvent,
    },
    /// An event of an edge's upstream link.
    Upstream {
        /// Its index.
        edge: usize,
        /// What.
        event: UpstreamEvent,
    },
}
