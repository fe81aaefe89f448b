//! Shows the progress of a command: as a bar on a terminal, as lines of text elsewhere, as lines of JSON under
//! `--json`.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use cosurf_agent::status::StatusBoard;
use cosurf_contract::{AgentEvent, ChosenBy, ComparedWith, Escaped, IngestStage, ReadyReport, counted};
use cosurf_engine::train::StepOutcome;
use indicatif::{ProgressBar, ProgressStyle};

/// Time between two lines of text about the training. Also the time between two [`AgentEvent::Preparing`] events, which
/// is the same for text, bar and JSON.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// Time between two updates of the training bar, or between two lines of JSON about the training.
const BAR_EVERY: Duration = Duration::from_millis(500);

/// Shows events, and the progress of training steps at intervals.
pub(super) struct Progress {
    style: Style,
    last: Instant,
    last_step: u32,
    /// Sum of the PSNR of all steps since the last update, dB, and the number of these steps.
    psnr: (f64, u32),
    /// Where the events are noted, too.
    board: Option<StatusBoard>,
    /// Events of another thread, if it has some.
    others: Option<Box<dyn FnMut() -> Option<AgentEvent>>>,
}

enum Style {
    Json,
    Lines,
    Bar(ProgressBar),
}

impl Progress {
    pub(super) fn new(json: bool) -> Self {
        let style = if json {
            Style::Json
        } else if std::io::stderr().is_terminal() {
            let bar = ProgressBar::new(0);
            let template = "{bar:30} {pos}/{len} {msg}";
            bar.set_style(
                ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()),
            );
            Style::Bar(bar)
        } else {
            Style::Lines
        };
        Self { style, last: Instant::now(), last_step: 0, psnr: (0.0, 0), board: None, others: None }
    }

    /// Notes all events on this board, too.
    pub(super) fn with_board(self, board: &StatusBoard) -> Self {
        Self { board: Some(board.clone()), ..self }
    }

    /// Shows also what `others` returns, whenever training has done a step.
    pub(super) fn listen(&mut self, others: impl FnMut() -> Option<AgentEvent> + 'static) {
        self.others = Some(Box::new(others));
    }

    fn show_others(&mut self) {
        while let Some(event) = self.others.as_mut().and_then(|others| others()) {
            self.show(&event);
        }
    }

    /// Records that training step `step` of `steps` is done. Shows the progress if an update is due, which is after
    /// [`LINE_EVERY`] or [`BAR_EVERY`] depending on the style, and after the last step.
    pub(super) fn step(&mut self, step: u32, steps: u32, outcome: &StepOutcome, splats: usize) {
        self.show_others();
        self.psnr = (self.psnr.0 + outcome.loss.psnr(), self.psnr.1 + 1);
        let every = if matches!(self.style, Style::Lines) { LINE_EVERY } else { BAR_EVERY };
        if self.last.elapsed() < every && step < steps {
            return;
        }
        let (steps_per_s, seconds_left) = self.rate(step, steps);
        self.show(&AgentEvent::Progress {
            step,
            steps,
            psnr: (self.psnr.0 / f64::from(self.psnr.1)) as f32,
            splats,
            steps_per_s,
            seconds_left,
        });
        (self.last, self.last_step, self.psnr) = (Instant::now(), step, (0.0, 0));
    }

    /// Steps per second since the last update, and the seconds left if the rate stays the same.
    fn rate(&self, step: u32, steps: u32) -> (f32, f32) {
        let steps_since = step - self.last_step.min(step);
        let steps_per_s = steps_since as f32 / self.last.elapsed().as_secs_f32().max(1e-6);
        (steps_per_s, (steps - step) as f32 / steps_per_s.max(1e-6))
    }

    /// Records how far the making of a dataset is. Shows it as [`Self::step`] does: if an update is due, and at the begin
    /// and the end of a stage.
    pub(super) fn ingesting(&mut self, event: &AgentEvent) {
        if let AgentEvent::Ingesting { done, of, .. } = event {
            let every = if matches!(self.style, Style::Lines) { LINE_EVERY } else { BAR_EVERY };
            if self.last.elapsed() < every && 0 < *done && done < of {
                return;
            }
            self.last = Instant::now();
        }
        self.show(event);
    }

    /// Records that step `step` of `steps` of training the base is done. (The base is the small model that is uploaded
    /// first.) Shows the progress if [`LINE_EVERY`] has passed.
    pub(super) fn preparing(&mut self, step: u32, steps: u32) {
        if step == 1 {
            (self.last, self.last_step) = (Instant::now(), step);
        }
        self.show_others();
        if self.last.elapsed() < LINE_EVERY {
            return;
        }
        let (_, seconds_left) = self.rate(step, steps);
        self.show(&AgentEvent::Preparing { step, steps, seconds_left });
        (self.last, self.last_step) = (Instant::now(), step);
    }

    pub(super) fn show(&mut self, event: &AgentEvent) {
        if let AgentEvent::Started { resumed_at, .. } = event {
            self.show_others();
            (self.last, self.last_step) = (Instant::now(), *resumed_at);
        }
        self.board.iter().for_each(|board| board.follow(event));
        match &self.style {
            Style::Json => {
                let line = serde_json::to_string(event).unwrap_or_default();
                // Write errors are ignored: training goes on after the reader has closed the pipe.
                let _ = writeln!(std::io::stdout(), "{line}");
            }
            Style::Bar(bar) => show_bar(bar, event),
            Style::Lines => {
                if let Some(line) = describe(event) {
                    // `eprintln!` would panic on a closed pipe and end the training.
                    let _ = writeln!(std::io::stderr(), "{}", Escaped(line));
                }
            }
        }
    }
}

fn show_bar(bar: &ProgressBar, event: &AgentEvent) {
    match event {
        AgentEvent::Progress { step, steps, psnr, splats, steps_per_s, seconds_left } => {
            bar.set_length(u64::from(*steps));
            bar.set_position(u64::from(*step));
            bar.set_message(format!(
                "{psnr:.2} dB, {splats} splats, {steps_per_s:.1} steps/s, {seconds_left:.0} s left"
            ));
        }
        AgentEvent::Trained { .. } => bar.finish(),
        AgentEvent::Ingesting { done, of, .. } if done < of => {
            bar.set_length(*of as u64);
            bar.set_position(*done as u64);
            bar.set_message(describe(event).unwrap_or_default());
        }
        _ => {
            if let Some(line) = describe(event) {
                bar.println(Escaped(line).to_string());
            }
        }
    }
}

/// The event as a line of text; `None` for events that are not shown as text.
fn describe(event: &AgentEvent) -> Option<String> {
    Some(match event {
        AgentEvent::ViewsChosen { by, pictures, of, resumed } => {
            let all = counted(*of as u64, "picture");
            let choice = match by {
                ChosenBy::Cell => format!("cell of the plan: {pictures} of {all}"),
                ChosenBy::NoCell => format!("the aggregator has no cell for this drone: all of {all}"),
                ChosenBy::NoPlan => format!("no plan came from the aggregator: all of {all}"),
                ChosenBy::Configuration => {
                    format!("`views` of the configuration, not a cell of the plan: {pictures} of {all}")
                }
            };
            if *resumed { format!("{choice}, as the training was begun") } else { choice }
        }
        AgentEvent::Watching { folder, problem: None } => {
            format!("waiting for pictures in {}", folder.display())
        }
        AgentEvent::Watching { folder, problem: Some(problem) } => {
            format!("{problem}; this flight is left, until something in {} changes", folder.display())
        }
        AgentEvent::Ingesting { stage, done, of, seconds_left, resumed } => {
            let stage = match stage {
                IngestStage::Reading => "photographs read",
                IngestStage::Features => "features",
                IngestStage::Matches => "matches",
                IngestStage::Poses => "poses",
                IngestStage::Adjusting => "adjusted",
                IngestStage::Undistorting => "undistorted",
            };
            let left = match seconds_left {
                _ if *resumed => ", by an earlier run".to_owned(),
                Some(left) if done < of => format!(", {left:.0} s left"),
                _ => String::new(),
            };
            format!("{stage}: {done}/{of}{left}")
        }
        AgentEvent::LeftOut { name, reason } => format!("left out: {name}: {reason}"),
        AgentEvent::Ingested { .. } => return None,
        AgentEvent::Ready { report } => {
            let ReadyReport { views, held_out, splats, size_px: [width, height], device, given_up } = report;
            let views = counted(*views as u64, "training view");
            let splats = counted(*splats as u64, "splat");
            let mut text =
                format!("ready: {views} of {width} x {height} px, {held_out} held out, {splats}, {device}");
            given_up.iter().for_each(|given_up| text += &format!("\nreduced to fit the memory: {given_up}"));
            text
        }
        AgentEvent::Started { views, held_out, splats, steps, resumed_at } => {
            let from =
                if *resumed_at > 0 { format!(", resumed at step {resumed_at}") } else { String::new() };
            format!(
                "{}, {held_out} held out, {}, {}{from}",
                counted(*views as u64, "training view"),
                counted(*splats as u64, "splat"),
                counted(*steps, "step")
            )
        }
        AgentEvent::Progress { step, steps, psnr, splats, steps_per_s, seconds_left } => format!(
            "step {step}/{steps}: {psnr:.2} dB, {splats} splats, {steps_per_s:.1} steps/s, {seconds_left:.0} s left"
        ),
        AgentEvent::DeviceLost { reason } => {
            format!("{reason}; training resumes on the CPU from the last checkpoint")
        }
        AgentEvent::CheckpointSetAside { reason, kept } => format!(
            "{reason}; it is set aside as {}, which may be deleted; training starts again",
            kept.display()
        ),
        AgentEvent::Trained { .. } => return None,
        AgentEvent::Preparing { step, steps, seconds_left } => {
            format!("preparing the upload: step {step}/{steps}, {seconds_left:.0} s left")
        }
        AgentEvent::Retrying { reason, attempt } => format!("{reason}; trying again (attempt {attempt})"),
        AgentEvent::Compressed { removed, of, others, unconfirmed } => {
            let known = counted(*others as u64, "other agent");
            let mut text =
                format!("dropped {removed} of {of} splats that other agents observed better ({known} known)");
            if *unconfirmed > 0 {
                text += &format!(
                    "; {unconfirmed} more had announced flights that the aggregator has not confirmed: they are old, or \
                     `key` and `trusted` are not set there or at the aggregator"
                );
            }
            text
        }
        AgentEvent::Publishing { bytes_arrived, bytes_total, .. } => {
            format!("{bytes_arrived} of {bytes_total} bytes have arrived")
        }
        AgentEvent::Acknowledged { bytes_sent } => {
            format!("the aggregator has stored the model ({bytes_sent} bytes sent)")
        }
        AgentEvent::GlobalReceived { revision, splats, verified } => {
            let splats = counted(*splats as u64, "splat");
            let doubt = if *verified { "" } else { " (not verified: `trusted` is not set)" };
            format!("received revision {revision} of the global model: {splats}{doubt}")
        }
        AgentEvent::GlobalRefused { revision, reason } => {
            format!("revision {revision} of the global model is not received: {reason}")
        }
        AgentEvent::Compared { with: ComparedWith::Init, changes } => {
            format!("changes since the initial model: {changes}")
        }
        AgentEvent::Compared { with: ComparedWith::Global, changes } => {
            format!("changes on this agent's ground in the global model: {changes}")
        }
    })
}
