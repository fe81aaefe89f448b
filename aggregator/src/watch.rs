//! The loop that watches a mission: everything that happens comes here, is shown, and is acted upon.

use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use crate::board::{Phase, Status};
use crate::fleet::{FleetEvent, FleetEventKind};
use crate::mission::{MissionError, Surroundings};
use crate::plan::Plan;
use crate::progress::Progress;
use crate::service::{BROKER_ATTEMPTS_MAX, ServiceEvent};
use crate::station::Station;

/// How often the loop looks up from listening.
const LOOK_UP: Duration = Duration::from_millis(100);

/// What happens in a mission.
pub(crate) enum Signal {
    /// To an agent.
    Fleet(FleetEvent),
    /// To the receiving service.
    Service(ServiceEvent),
}

/// The watch over one mission.
pub(crate) struct Watch<'a> {
    plan: &'a Plan,
    around: &'a Surroundings,
    signals: Receiver<Signal>,
    progress: Progress,
    board: Vec<Status>,
    connected: bool,
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
            connected: false,
        }
    }

    /// Returns once the service has reached the broker.
    pub(crate) fn await_broker(&mut self, station: &Station) -> Result<(), MissionError> {
        while !self.connected {
            self.step(station)?;
        }
        Ok(())
    }

    /// Returns once every agent has ended, well or not, with what is known of each.
    pub(crate) fn await_agents(mut self, station: &Station) -> Result<Vec<Status>, MissionError> {
        let ended = |status: &Status| matches!(status.phase, Phase::Ended | Phase::Failed { .. });
        while !self.board.iter().all(ended) {
            self.step(station)?;
        }
        self.progress.finish();
        Ok(self.board)
    }

    fn step(&mut self, station: &Station) -> Result<(), MissionError> {
        match self.signals.recv_timeout(LOOK_UP) {
            Ok(Signal::Fleet(event)) => self.take_fleet(&event, station),
            Ok(Signal::Service(event)) => self.take_service(event)?,
            Err(RecvTimeoutError::Timeout) if !station.has_died() => {}
            Err(_) => return Err(MissionError::ServiceDied),
        }
        self.progress.tick(&self.board, (self.around.now)().as_secs_f64());
        if self.around.interrupted.load(Ordering::SeqCst) {
            return Err(MissionError::Interrupted);
        }
        Ok(())
    }

    fn take_fleet(&mut self, event: &FleetEvent, station: &Station) {
        let (device, status) = (self.plan.devices[event.agent], &mut self.board[event.agent]);
        if let Some(line) = status.take(&event.kind) {
            self.progress.notice(&format!("{device}: {line}"));
        }
        if matches!(event.kind, FleetEventKind::Failed { .. }) {
            station.give_up(device);
        }
        self.progress.show(event, status);
    }

    fn take_service(&mut self, event: ServiceEvent) -> Result<(), MissionError> {
        match event {
            ServiceEvent::Connected => self.connected = true,
            ServiceEvent::Disconnected { attempt, reason }
                if !self.connected && attempt >= BROKER_ATTEMPTS_MAX =>
            {
                return Err(MissionError::NoBroker { reason });
            }
            ServiceEvent::DiskFailed { reason } => return Err(MissionError::Disk { reason }),
            event => self.progress.notice(&format!("aggregator: {event}")),
        }
        Ok(())
    }
}
