//! How far an agent is: what it tells over its link every few seconds.

use serde::{Deserialize, Serialize};

use crate::report::{AgentEvent, ChosenBy};

/// Limit on the characters of a problem in a status, so that a status stays small.
const PROBLEM_CHARS_MAX: usize = 200;

/// Limit on the bytes of a status: several times what an agent sends.
const STATUS_BYTES_MAX: usize = 4096;
/// Limit on the characters of a version in a status.
const VERSION_CHARS_MAX: usize = 40;

/// Why bytes are no status.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BadStatus {
    /// There are too many bytes.
    #[error("a status of {0} bytes, but at most {STATUS_BYTES_MAX} are read")]
    TooLong(usize),
    /// It is not the JSON of a status.
    #[error("not a status: {0}")]
    Malformed(#[from] serde_json::Error),
    /// A figure or a text is out of its range.
    #[error("a status whose {0} is out of range")]
    OutOfRange(&'static str),
}

/// A problem, as short as statuses allow.
fn short(problem: &str) -> String {
    problem.chars().take(PROBLEM_CHARS_MAX).collect()
}

/// How far an agent is. Anybody who may write to the agent's topics may have written it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgentStatus {
    /// What the agent is doing.
    pub phase: AgentPhase,
    /// Number of pictures in the agent's cell of the site's plan; `None` if the agent does not train by a cell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cell_pictures: Option<usize>,
    /// Number of training steps done.
    pub step: u32,
    /// Number of all training steps.
    pub steps: u32,
    /// Mean PSNR of the last training steps, or of the trained model on held-out pictures, dB; `None` before the first.
    pub psnr: Option<f32>,
    /// Number of splats.
    pub splats: usize,
    /// Estimated time until the end of the training, or of the base, seconds; `None` if not known.
    pub seconds_left: Option<f32>,
    /// Bytes of the model that have arrived at the aggregator.
    #[serde(default)]
    pub bytes_arrived: u64,
    /// Bytes of all messages of the upload so far.
    pub bytes_sent: u64,
    /// Size of the encoded model in bytes; 0 before the upload.
    pub bytes_total: u64,
    /// Resident memory of the agent, bytes.
    pub memory_bytes: u64,
    /// When the agent wrote this, seconds since 1970 by its clock.
    pub time_s: u64,
    /// The last problem, if the agent has not got over it; at most 200 characters.
    pub problem: Option<String>,
    /// Version of the agent.
    pub version: String,
}

/// What an agent is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AgentPhase {
    /// Reads the pictures and prepares the training.
    Loading,
    /// Trains.
    Training,
    /// Prepares the upload: trains the small model that is sent first, and waits for the flights of other agents.
    Preparing,
    /// Sends its model.
    Uploading,
    /// Waits: for pictures in the folder that it watches, or, once the aggregator has stored the agent's model, for the
    /// global model.
    Waiting,
    /// Has finished.
    Done,
    /// Has ended before it was done. [`AgentStatus::problem`] tells why.
    Failed,
}

impl AgentStatus {
    /// The status of an agent that has just started.
    pub fn new(steps: u32, version: &str) -> Self {
        Self {
            phase: AgentPhase::Loading,
            cell_pictures: None,
            step: 0,
            steps,
            psnr: None,
            splats: 0,
            seconds_left: None,
            bytes_arrived: 0,
            bytes_sent: 0,
            bytes_total: 0,
            memory_bytes: 0,
            time_s: 0,
            problem: None,
            version: version.to_owned(),
        }
    }

    /// Reads a status that anybody may have sent.
    pub fn parse(payload: &[u8]) -> Result<Self, BadStatus> {
        if payload.len() > STATUS_BYTES_MAX {
            return Err(BadStatus::TooLong(payload.len()));
        }
        let status: Self = serde_json::from_slice(payload)?;
        let is_usual = |value: Option<f32>, least: f32| value.is_none_or(|v| v.is_finite() && v >= least);
        let is_short = |text: &str, most: usize| text.chars().count() <= most;
        let checks = [
            ("psnr", is_usual(status.psnr, f32::MIN)),
            ("seconds_left", is_usual(status.seconds_left, 0.0)),
            ("problem", status.problem.as_deref().is_none_or(|text| is_short(text, PROBLEM_CHARS_MAX))),
            ("version", is_short(&status.version, VERSION_CHARS_MAX)),
        ];
        match checks.into_iter().find(|(_, is_good)| !is_good) {
            Some((what, _)) => Err(BadStatus::OutOfRange(what)),
            None => Ok(status),
        }
    }

    /// Notes that the agent ends before it is done, and why.
    pub fn fail(&mut self, reason: &str) {
        (self.phase, self.seconds_left) = (AgentPhase::Failed, None);
        self.problem = Some(short(reason));
    }

    /// Notes an event of the agent. Returns whether the status should be told at once.
    pub fn follow(&mut self, event: &AgentEvent) -> bool {
        let before = self.phase;
        if let AgentEvent::Retrying { reason, .. } | AgentEvent::GlobalRefused { reason, .. } = event {
            self.problem = Some(short(reason));
        }
        match event {
            AgentEvent::Watching { problem, .. } => {
                (self.phase, self.seconds_left) = (AgentPhase::Waiting, None);
                self.problem = problem.as_deref().map(short);
            }
            AgentEvent::ViewsChosen { by, pictures, .. } => {
                self.phase = AgentPhase::Loading;
                self.cell_pictures = (*by == ChosenBy::Cell).then_some(*pictures);
            }
            AgentEvent::Started { splats, steps, resumed_at, .. } => {
                self.phase = AgentPhase::Training;
                (self.splats, self.steps, self.step) = (*splats, *steps, *resumed_at);
            }
            AgentEvent::Progress { step, steps, psnr, splats, seconds_left, .. } => {
                self.phase = AgentPhase::Training;
                (self.step, self.steps, self.splats) = (*step, *steps, *splats);
                (self.psnr, self.seconds_left) = (Some(*psnr), Some(*seconds_left));
            }
            AgentEvent::Trained { report } => {
                self.phase = AgentPhase::Preparing;
                (self.step, self.splats, self.seconds_left) = (report.steps, report.splats, None);
                self.psnr = report.psnr.map(|psnr| psnr as f32).or(self.psnr);
            }
            AgentEvent::Preparing { seconds_left, .. } => {
                (self.phase, self.seconds_left) = (AgentPhase::Preparing, Some(*seconds_left));
            }
            AgentEvent::Compressed { .. } => self.seconds_left = None,
            AgentEvent::Publishing { bytes_arrived, bytes_sent, bytes_total } => {
                (self.phase, self.problem, self.seconds_left) = (AgentPhase::Uploading, None, None);
                (self.bytes_arrived, self.bytes_sent) = (*bytes_arrived, *bytes_sent);
                self.bytes_total = *bytes_total;
            }
            AgentEvent::Acknowledged { bytes_sent } => {
                (self.phase, self.problem, self.seconds_left) = (AgentPhase::Waiting, None, None);
                (self.bytes_arrived, self.bytes_sent) = (self.bytes_total, *bytes_sent);
            }
            AgentEvent::Ingesting { .. } => self.phase = AgentPhase::Loading,
            AgentEvent::GlobalReceived { .. } => self.problem = None,
            AgentEvent::DeviceLost { .. }
            | AgentEvent::CheckpointSetAside { .. }
            | AgentEvent::Ready { .. }
            | AgentEvent::LeftOut { .. }
            | AgentEvent::Ingested { .. }
            | AgentEvent::Retrying { .. }
            | AgentEvent::GlobalRefused { .. }
            | AgentEvent::Compared { .. } => {}
        }
        self.phase != before
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_status_follows_the_events_and_stays_small() {
        let mut status = AgentStatus::new(300, "0.1.0");
        let chosen = |by| AgentEvent::ViewsChosen { by, pictures: 10, of: 40, resumed: false };
        for (by, pictures) in [(ChosenBy::Cell, Some(10)), (ChosenBy::NoCell, None)] {
            assert!(!status.follow(&chosen(by)) && status.cell_pictures == pictures);
        }
        let watching = |problem| AgentEvent::Watching { folder: "flights".into(), problem };
        assert!(status.follow(&watching(Some("no picture".into()))));
        assert_eq!(status.problem.as_deref(), Some("no picture"));
        status.follow(&watching(None));
        assert_eq!(status.problem, None);
        assert_eq!(serde_json::to_value(&status).unwrap()["phase"], "waiting");
        assert!(status.follow(&chosen(ChosenBy::NoPlan)) && status.phase == AgentPhase::Loading);
        let started = AgentEvent::Started { views: 9, held_out: 1, splats: 100, steps: 300, resumed_at: 20 };
        assert!(status.follow(&started) && status.phase == AgentPhase::Training && status.step == 20);
        let retrying = AgentEvent::Retrying { reason: "\u{1F4A5}".repeat(9000), attempt: 1 };
        assert!(!status.follow(&retrying));
        let text = serde_json::to_string(&status).unwrap();
        assert!(text.len() < 1200, "{} bytes", text.len());
        assert_eq!(serde_json::from_str::<AgentStatus>(&text).unwrap(), status);
        assert_eq!(AgentStatus::parse(text.as_bytes()).unwrap(), status);
        assert!(status.follow(&AgentEvent::Publishing { bytes_arrived: 3, bytes_sent: 5, bytes_total: 9 }));
        assert_eq!(
            (status.problem.clone(), status.bytes_arrived, status.bytes_total),
            (None, 3, 9),
            "it has got over the problem"
        );
        assert!(status.follow(&AgentEvent::Acknowledged { bytes_sent: 11 }));
        assert_eq!((status.phase, status.bytes_arrived, status.bytes_sent), (AgentPhase::Waiting, 9, 11));
    }

    #[test]
    fn a_status_out_of_range_is_refused() {
        let good = serde_json::to_value(AgentStatus::new(300, "0.1.0")).unwrap();
        let with = |name: &str, value: serde_json::Value| {
            let mut changed = good.clone();
            changed[name] = value;
            AgentStatus::parse(changed.to_string().as_bytes())
        };
        assert!(with("psnr", serde_json::json!(30.5)).is_ok());
        assert!(with("psnr", serde_json::json!(1e300)).is_err(), "it is infinite as a 32-bit number");
        assert!(with("seconds_left", serde_json::json!(-1.0)).is_err());
        assert!(matches!(with("problem", "x".repeat(201).into()), Err(BadStatus::OutOfRange("problem"))));
        assert!(with("version", "x".repeat(41).into()).is_err());
        assert!(with("step", serde_json::json!(-1)).is_err());
        assert!(matches!(with("problem", "x".repeat(5000).into()), Err(BadStatus::TooLong(_))));
        assert!(AgentStatus::parse(b"\xff\x00").is_err());
    }
}
