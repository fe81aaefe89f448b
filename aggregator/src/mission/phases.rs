//! How long the phases of a mission take.
//!
//! What it knows nothing about: what happens in them.

use std::time::Duration;

use super::order::Surroundings;
use crate::report::PhaseTime;

/// Notes how long each phase took, one after the other.
pub(super) struct Phases<'a> {
    around: &'a Surroundings,
    /// When the phase that runs began.
    begun: Duration,
    done: Vec<PhaseTime>,
}

impl<'a> Phases<'a> {
    /// The first phase begins now. `ingest_s`: seconds of the one before the mission began, if there was one.
    pub(super) fn begin(around: &'a Surroundings, ingest_s: Option<f64>) -> Self {
        let ingest = ingest_s.map(|seconds| PhaseTime { phase: "photographs to poses".into(), seconds });
        Self { around, begun: (around.now)(), done: ingest.into_iter().collect() }
    }

    /// Ends a phase; the next one begins.
    pub(super) fn end(&mut self, phase: &str) {
        let now = (self.around.now)();
        self.done.push(PhaseTime { phase: phase.into(), seconds: (now - self.begun).as_secs_f64() });
        self.begun = now;
    }

    pub(super) fn into_times(self) -> Vec<PhaseTime> {
        self.done
    }
}
