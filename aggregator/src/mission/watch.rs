//! The event loop of a mission: receives every event, shows it, and acts on it.

use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use cosurf_contract::{AgentPhase, AgentStatus};

use super::agents::{ProcessEvent, ProcessEventKind};
use super::board::{Phase, Status};
use super::error::MissionError;
use super::hierarchy::Hierarchy;
use super::order::Surroundings;
use super::plan::{Edge, Plan};
use super::progress::Progress;
use super::signal::Signal;
use crate::service::{BROKER_ATTEMPTS_MAX, ServiceEvent, UpstreamEvent};

/// Longest wait for an event before the loop checks for an interruption.
const LOOK_UP: Duration = Duration::from_millis(100);

/// The status of an edge.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct EdgeStatus {
    /// Bytes that the edge sent to the root for its last delivered revision, resends included.
    pub(crate) bytes_sent: u64,
    /// True once the edge has the root's global model, or the root has finally refused the edge's model.
    is_served: bool,
}

/// The state of the event loop.
pub(crate) struct Watch<'a> {
    plan: &'a Plan,
    around: &'a Surroundings,
    signals: Receiver<Signal>,
    progress: Progress,
    board: Vec<Status>,
    /// The status of each agent as the ground station shows it.
    shown: Vec<AgentStatus>,
    edges: Vec<EdgeStatus>,
    /// For each post in the hierarchy, whether its aggregator has reached the broker.
    connected: Vec<bool>,
}

impl<'a> Watch<'a> {
    pub(crate) fn new(plan: &'a Plan, around: &'a Surroundings, signals: Receiver<Signal>) -> Self {
        let names = plan.devices.iter().map(|device| device.to_string()).collect();
        Self {
            plan,
            around,
            signals,
            progress: Progress::new(names, around.display),
            board: plan.devices.iter().map(|_| Status::default()).collect(),
            shown: vec![AgentStatus::new(0, env!("CARGO_PKG_VERSION")); plan.devices.len()],
            edges: vec![EdgeStatus::default(); plan.edges.len()],
            connected: vec![false; 1 + plan.edges.len()],
        }
    }

    /// Returns once every aggregator has reached the broker.
    pub(crate) fn await_broker(&mut self, hierarchy: &Hierarchy) -> Result<(), MissionError> {
        while !self.connected.iter().all(|connected| *connected) {
            self.step(hierarchy)?;
        }
        Ok(())
    }

    /// Returns once every agent has ended or failed.
    pub(crate) fn await_agents(&mut self, hierarchy: &Hierarchy) -> Result<(), MissionError> {
        let ended = |status: &Status| matches!(status.phase, Phase::Ended | Phase::Failed { .. });
        while !self.board.iter().all(ended) {
            self.step(hierarchy)?;
        }
        self.progress.finish();
        Ok(())
    }

    /// Closes the edges. Returns once each edge with a model has the root's global model or a final refusal.
    pub(crate) fn await_edges(&mut self, hierarchy: &mut Hierarchy) -> Result<(), MissionError> {
        let have_models = hierarchy.close_edges();
        while self.edges.iter().zip(&have_models).any(|(edge, has_model)| *has_model && !edge.is_served) {
            self.step(hierarchy)?;
        }
        Ok(())
    }

    /// The status of each agent and of each edge.
    pub(crate) fn into_boards(self) -> (Vec<Status>, Vec<EdgeStatus>) {
        (self.board, self.edges)
    }

    fn step(&mut self, hierarchy: &Hierarchy) -> Result<(), MissionError> {
        match self.signals.recv_timeout(LOOK_UP) {
            Ok(Signal::Agent(event)) => self.take_agent(&event, hierarchy),
            Ok(Signal::Service { post, event }) => self.take_service(post, event, hierarchy)?,
            Ok(Signal::Upstream { edge, event }) => self.take_upstream(edge, &event),
            Err(RecvTimeoutError::Timeout) if !hierarchy.has_died() => {}
            Err(_) => return Err(MissionError::ServiceDied),
        }
        self.progress.tick(&self.board, (self.around.now)().as_secs_f64());
        if self.around.interrupted.load(Ordering::SeqCst) {
            return Err(MissionError::Interrupted);
        }
        Ok(())
    }

    fn take_agent(&mut self, event: &ProcessEvent, hierarchy: &Hierarchy) {
        self.show_agent(event);
        let (device, status) = (self.plan.devices[event.agent], &mut self.board[event.agent]);
        if let Some(line) = status.take(&event.kind) {
            self.progress.notice(&format!("{device}: {line}"));
        }
        if matches!(event.kind, ProcessEventKind::Failed { .. }) {
            hierarchy.give_up(event.agent, device);
        }
        self.progress.show(event, status);
        let have_failed = |edge: &Edge| {
            let mut agents = self.board[edge.agents.clone()].iter();
            edge.agents.contains(&event.agent)
                && agents.all(|status| matches!(status.phase, Phase::Failed { .. }))
        };
        if let Some(edge) = self.plan.edges.iter().position(have_failed) {
            hierarchy.give_up_edge(1 + edge);
        }
    }

    /// Shows an agent's event in the ground station.
    fn show_agent(&mut self, event: &ProcessEvent) {
        let Some(board) = &self.around.board else { return };
        let shown = &mut self.shown[event.agent];
        match &event.kind {
            ProcessEventKind::Said(event) => {
                shown.follow(event);
            }
            ProcessEventKind::Ended => shown.phase = AgentPhase::Done,
            ProcessEventKind::Restarting { reason, .. } | ProcessEventKind::Failed { reason } => {
                shown.problem = Some(reason.clone());
            }
        }
        board.note_status(self.plan.devices[event.agent], shown.clone());
    }

    fn take_service(
        &mut self,
        post: usize,
        event: ServiceEvent,
        hierarchy: &Hierarchy,
    ) -> Result<(), MissionError> {
        if let (0, Some(board)) = (post, &self.around.board) {
            board.note_service(&event);
        }
        match &event {
            ServiceEvent::Connected => {
                self.connected[post] = true;
                return Ok(());
            }
            ServiceEvent::Disconnected { attempt, reason }
                if !self.connected[post] && *attempt >= BROKER_ATTEMPTS_MAX =>
            {
                return Err(MissionError::NoBroker { reason: reason.clone() });
            }
            ServiceEvent::DiskFailed { reason } => {
                return Err(MissionError::Disk { reason: reason.clone() });
            }
            ServiceEvent::Merged { header, .. } => hierarchy.send_up(post, *header),
            ServiceEvent::NothingMerged { .. } => hierarchy.give_up_edge(post),
            _ => {}
        }
        let name = match post.checked_sub(1) {
            None => "aggregator",
            Some(edge) => self.plan.edges[edge].device.as_str(),
        };
        self.progress.notice(&format!("{name}: {event}"));
        Ok(())
    }

    fn take_upstream(&mut self, edge: usize, event: &UpstreamEvent) {
        let status = &mut self.edges[edge];
        match event {
            UpstreamEvent::UpstreamConnected => return,
            UpstreamEvent::SentUp { bytes_sent, .. } => status.bytes_sent = *bytes_sent,
            UpstreamEvent::CameDown { .. } => status.is_served = true,
            UpstreamEvent::NotReceived { .. } => status.is_served = true,
            UpstreamEvent::RefusedAbove { reason, .. } => status.is_served |= !reason.is_temporary(),
            _ => {}
        }
        self.progress.notice(&format!("{}: {event}", self.plan.edges[edge].device));
    }
}
