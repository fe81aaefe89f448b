//! The status of each agent of a mission, gathered from the agent's events.

use cosurf_contract::{AgentEvent, Curve, TrainReport};

use super::agents::{ProcessEventKind, RESTARTS_MAX};

/// The phase of an agent's work.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) enum Phase {
    /// The agent's process was started or is about to be restarted, and training has not begun yet.
    #[default]
    Starting,
    /// The agent trains.
    Training,
    /// The training is done, and the agent uploads its model.
    Publishing,
    /// The upload is acknowledged, and the agent waits for the global model.
    Waiting,
    /// The agent has the global model.
    Done,
    /// The process exited without an error.
    Ended,
    /// The process failed and is not restarted.
    Failed {
        /// The reason, one line.
        reason: String,
    },
}

/// The status of one agent.
#[derive(Clone, Debug, Default)]
pub(crate) struct Status {
    pub(crate) phase: Phase,
    pub(crate) step: u32,
    pub(crate) steps: u32,
    /// Training PSNR, the mean over the latest pictures, dB.
    pub(crate) psnr: f32,
    pub(crate) splats: usize,
    pub(crate) steps_per_s: f32,
    pub(crate) seconds_left: f32,
    /// Bytes of the model that have arrived at the aggregator.
    pub(crate) bytes_arrived: u64,
    pub(crate) bytes_sent: u64,
    pub(crate) bytes_total: u64,
    pub(crate) restarts: u32,
    /// Report of the training; `None` until the training is done.
    pub(crate) training: Option<TrainReport>,
    /// Training curve of the steps that this process saw.
    pub(crate) curve: Curve,
}

impl Status {
    /// Whether the agent learnt the poses of its pictures, because they were not exact.
    pub(crate) fn has_learnt_poses(&self) -> bool {
        self.training.as_ref().is_some_and(|training| training.poses_moved_px.is_some())
    }

    /// Updates the status with an event. Returns a line to show to the user if the event is unusual.
    pub(crate) fn take(&mut self, event: &ProcessEventKind) -> Option<String> {
        match event {
            ProcessEventKind::Said(event) => return self.listen(event),
            ProcessEventKind::Restarting { attempt, reason } => {
                self.restarts = *attempt;
                self.phase = Phase::Starting;
                return Some(format!("died ({reason}); restart {attempt} of {RESTARTS_MAX}"));
            }
            ProcessEventKind::Ended => self.phase = Phase::Ended,
            ProcessEventKind::Failed { reason } => {
                self.phase = Phase::Failed { reason: reason.clone() };
                return Some(format!("failed: {reason}"));
            }
        }
        None
    }

    fn listen(&mut self, event: &AgentEvent) -> Option<String> {
        match event {
            AgentEvent::Started { splats, steps, resumed_at, .. } => {
                self.phase = Phase::Training;
                (self.step, self.steps, self.splats) = (*resumed_at, *steps, *splats);
                return (*resumed_at > 0).then(|| format!("resumes from step {resumed_at}"));
            }
            AgentEvent::Progress { step, steps, psnr, splats, steps_per_s, seconds_left } => {
                (self.step, self.steps, self.psnr, self.splats) = (*step, *steps, *psnr, *splats);
                (self.steps_per_s, self.seconds_left) = (*steps_per_s, *seconds_left);
                self.curve.push(*step, *psnr);
            }
            AgentEvent::ViewsChosen { .. }
            | AgentEvent::Ready { .. }
            | AgentEvent::Watching { .. }
            | AgentEvent::DeviceLost { .. }
            | AgentEvent::Preparing { .. }
            | AgentEvent::Ingesting { .. }
            | AgentEvent::LeftOut { .. }
            | AgentEvent::Ingested { .. }
            | AgentEvent::Compared { .. }
            | AgentEvent::Compressed { .. } => {}
            AgentEvent::Trained { report } => {
                self.phase = Phase::Publishing;
                (self.step, self.steps, self.splats) = (report.steps, report.steps, report.splats);
                self.training = Some(report.clone());
            }
            AgentEvent::CheckpointSetAside { reason, .. } => {
                return Some(format!("{reason}; training starts again"));
            }
            AgentEvent::Retrying { reason, attempt } => {
                return Some(format!("{reason}; trying again (attempt {attempt})"));
            }
            AgentEvent::Publishing { bytes_arrived, bytes_sent, bytes_total } => {
                self.phase = Phase::Publishing;
                (self.bytes_arrived, self.bytes_sent) = (*bytes_arrived, *bytes_sent);
                self.bytes_total = *bytes_total;
            }
            AgentEvent::Acknowledged { bytes_sent } => {
                self.phase = Phase::Waiting;
                self.bytes_sent = *bytes_sent;
            }
            AgentEvent::GlobalReceived { .. } => self.phase = Phase::Done,
            AgentEvent::GlobalRefused { revision, reason } => {
                self.phase = Phase::Done;
                return Some(format!("revision {revision} of the global model is not received: {reason}"));
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn progress(step: u32) -> ProcessEventKind {
        ProcessEventKind::Said(AgentEvent::Progress {
            step,
            steps: 1000,
            psnr: 20.0,
            splats: 5,
            steps_per_s: 50.0,
            seconds_left: 3.0,
        })
    }

    #[test]
    fn a_restart_takes_the_curve_back_to_the_checkpoint() {
        let mut status = Status::default();
        for step in [100, 200, 300] {
            assert_eq!(status.take(&progress(step)), None);
        }
        let restart = ProcessEventKind::Restarting { attempt: 1, reason: "signal: 9".into() };
        assert!(status.take(&restart).is_some_and(|line| line.contains("restart 1 of 5")));
        status.take(&progress(150));
        let steps: Vec<f32> = status.curve.points().iter().map(|point| point[0]).collect();
        assert_eq!((steps, status.restarts), (vec![100.0, 150.0], 1));
    }
}
