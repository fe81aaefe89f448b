//! Shows the progress of a mission: a bar per agent on a terminal, else a line per agent every few seconds, or
//! every event as a line of JSON for scripts.

use std::io::{self, Write};

use cosurf_scene::bytes::format_bytes;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::json;

use super::agents::{ProcessEvent, ProcessEventKind};
use super::board::{Phase, Status};
use crate::terminal::{Display, format_seconds};
use cosurf_contract::{Escaped, counted};

/// Seconds between two rounds of plain lines.
const LINES_EVERY_S: f64 = 5.0;

/// Number of rendered pictures of the city between two plain lines.
const PICTURES_EVERY: usize = 32;

/// The progress display of a mission.
pub(crate) struct Progress {
    names: Vec<String>,
    display: Display,
    bars: MultiProgress,
    bar_of: Vec<ProgressBar>,
    shown_at_s: f64,
}

impl Progress {
    /// A display of agents with these names.
    pub(crate) fn new(names: Vec<String>, display: Display) -> Self {
        let bars = MultiProgress::with_draw_target(match display {
            Display::Bars => ProgressDrawTarget::stderr_with_hz(8),
            Display::Lines | Display::Json => ProgressDrawTarget::hidden(),
        });
        let style = ProgressStyle::with_template("{prefix:10} {bar:20.cyan/dim} {wide_msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar())
            .progress_chars("━╸─");
        let bar = |name: &String| {
            let bar = bars.add(ProgressBar::new(1).with_style(style.clone()).with_prefix(name.clone()));
            bar.set_message("starting");
            bar
        };
        let bar_of = names.iter().map(bar).collect();
        Self { names, display, bars, bar_of, shown_at_s: 0.0 }
    }

    /// Prints an unusual event at once.
    pub(crate) fn notice(&self, line: &str) {
        let line = Escaped(line).to_string();
        let shown = match self.display {
            Display::Bars => self.bars.println(line),
            Display::Lines | Display::Json => writeln!(io::stderr(), "{line}"),
        };
        let _ = shown; // write errors are ignored: the mission goes on
    }

    /// Shows an agent's event; `status` already includes it.
    pub(crate) fn show(&self, event: &ProcessEvent, status: &Status) {
        if self.display == Display::Json {
            let line = json_line(&self.names[event.agent], &event.kind);
            let _ = writeln!(io::stdout(), "{line}");
        }
        let bar = &self.bar_of[event.agent];
        bar.set_length(u64::from(status.steps.max(1)));
        bar.set_position(u64::from(status.step));
        bar.set_message(describe(status));
    }

    /// With [`Display::Lines`], prints a line for each agent every few seconds. `now_s` is the time in seconds since
    /// any fixed moment.
    pub(crate) fn tick(&mut self, board: &[Status], now_s: f64) {
        if self.display != Display::Lines || now_s - self.shown_at_s < LINES_EVERY_S {
            return;
        }
        self.shown_at_s = now_s;
        for (name, status) in self.names.iter().zip(board) {
            self.notice(&format!("{name}  {}", describe(status)));
        }
    }

    /// Ends the display. The bars stay on the terminal as they are.
    pub(crate) fn finish(&self) {
        self.bar_of.iter().for_each(|bar| bar.abandon());
    }
}

/// Shows how many pictures of the synthetic city are rendered: in place on a terminal, else as a line after every
/// [`PICTURES_EVERY`] pictures and after the last.
pub(crate) fn show_pictures(display: Display, done: usize, of: usize) {
    let mut stderr = io::stderr().lock();
    let shown = match display {
        Display::Bars if done < of => {
            write!(stderr, "\rcity: {done} of {of} pictures").and_then(|()| stderr.flush())
        }
        Display::Bars => writeln!(stderr, "\rcity: {of} pictures         "),
        Display::Lines | Display::Json if done == of || done.is_multiple_of(PICTURES_EVERY) => {
            writeln!(stderr, "city: {done} of {of} pictures")
        }
        Display::Lines | Display::Json => Ok(()),
    };
    let _ = shown; // write errors are ignored: the mission goes on
}

/// Describes the status of an agent in one line.
fn describe(status: &Status) -> String {
    let splats = counted(status.splats, "splat");
    match &status.phase {
        Phase::Starting => "starting".into(),
        Phase::Training => format!(
            "step {} of {} · {:.1} steps/s · {:.2} dB · {splats} · {} left",
            status.step,
            status.steps,
            status.steps_per_s,
            status.psnr,
            format_seconds(f64::from(status.seconds_left)),
        ),
        Phase::Publishing => format!(
            "trained · {splats} · {} of {} have arrived",
            format_bytes(status.bytes_arrived),
            format_bytes(status.bytes_total)
        ),
        Phase::Waiting => format!("{splats} uploaded · waiting for the global model"),
        Phase::Done | Phase::Ended => format!("done · {splats}"),
        Phase::Failed { reason } => format!("failed: {reason}"),
    }
}

fn json_line(agent: &str, event: &ProcessEventKind) -> String {
    let mut line = match event {
        ProcessEventKind::Said(event) => json!(event),
        ProcessEventKind::Restarting { attempt, reason } => {
            json!({"event": "restarting", "attempt": attempt, "reason": reason})
        }
        ProcessEventKind::Ended => json!({"event": "ended"}),
        ProcessEventKind::Failed { reason } => json!({"event": "failed", "reason": reason}),
    };
    line["agent"] = agent.into();
    line.to_string()
}

#[cfg(test)]
mod tests {
    use cosurf_contract::AgentEvent;

    use super::*;

    #[test]
    fn a_json_event_has_the_name_of_its_agent() {
        let event = ProcessEventKind::Said(AgentEvent::Acknowledged { bytes_sent: 7 });
        assert_eq!(
            json_line("agent-1", &event),
            r#"{"agent":"agent-1","bytes_sent":7,"event":"acknowledged"}"#
        );
    }

    #[test]
    fn an_agent_is_described_in_every_phase() {
        let mut status = Status { steps: 100, step: 7, steps_per_s: 2.0, splats: 9, ..Status::default() };
        status.phase = Phase::Training;
        status.seconds_left = 46.5;
        assert_eq!(describe(&status), "step 7 of 100 · 2.0 steps/s · 0.00 dB · 9 splats · 47 s left");
        status.phase = Phase::Failed { reason: "no images".into() };
        assert_eq!(describe(&status), "failed: no images");
    }
}
