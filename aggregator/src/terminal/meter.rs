//! Shows the progress of a long task: as a bar on a terminal, otherwise as a line every few seconds, or as lines of
//! JSON for scripts.

use std::io::{self, Write};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::json;

use super::display::{Display, format_seconds};
use crate::mesh::{FuseEvent, Stage};
use cosurf_contract::counted;

/// Seconds between two lines, of text or of JSON.
const LINES_EVERY_S: f64 = 5.0;

/// The progress display of a task.
pub struct Meter {
    display: Display,
    bar: ProgressBar,
    /// Name of the current stage; time when the first event of the stage was shown; time when a line about the stage
    /// was last due. Both times are in seconds.
    stage: Option<(&'static str, f64, f64)>,
}

impl Meter {
    /// A display that shows nothing yet.
    pub fn new(display: Display) -> Self {
        let bar = ProgressBar::with_draw_target(
            Some(1),
            match display {
                Display::Bars => ProgressDrawTarget::stderr_with_hz(8),
                Display::Lines | Display::Json => ProgressDrawTarget::hidden(),
            },
        );
        let style = ProgressStyle::with_template("{prefix:10} {bar:20.cyan/dim} {wide_msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar())
            .progress_chars("━╸─");
        Self { display, bar: bar.with_style(style), stage: None }
    }

    /// Shows that `stage` has finished `done` (at least 1) of `of` views. `now_s` is the time in seconds since any
    /// fixed moment.
    pub fn show(&mut self, stage: &'static str, done: usize, of: usize, now_s: f64) {
        self.show_counted("view", stage, done, of, now_s);
    }

    /// As [`Self::show`], for a stage that counts something else than views: `unit` is its singular.
    pub fn show_counted(&mut self, unit: &str, stage: &'static str, done: usize, of: usize, now_s: f64) {
        let (begun_s, shown_s) = match self.stage {
            Some((shown, begun_s, shown_s)) if shown == stage && done > 1 => (begun_s, shown_s),
            _ => (now_s, now_s),
        };
        let is_due = done == of || now_s - shown_s >= LINES_EVERY_S;
        self.stage = Some((stage, begun_s, if is_due { now_s } else { shown_s }));
        // The rate is counted from the end of the first one, because the start of the stage is not reported.
        let per_s = done.saturating_sub(1) as f64 / (now_s - begun_s);
        let rate = if per_s > 0.0 && per_s.is_finite() {
            format!(
                " · {per_s:.1} {unit}s/s · {} left",
                format_seconds(of.saturating_sub(done) as f64 / per_s)
            )
        } else {
            String::new()
        };
        let text = format!("{done} of {}{rate}", counted(of, unit));
        match self.display {
            Display::Bars => {
                self.bar.set_length(of as u64);
                self.bar.set_position(done as u64);
                self.bar.set_prefix(stage);
                self.bar.set_message(text);
            }
            Display::Lines if is_due => self.notice(&format!("{stage}  {text}")),
            Display::Json if is_due => {
                let line = json!({"event": "progress", "stage": stage, "done": done, "of": of});
                let _ = writeln!(io::stdout(), "{line}"); // write errors are ignored: the task goes on
            }
            Display::Lines | Display::Json => {}
        }
    }

    /// Shows an event of a mesh fusion. `now_s` is the time in seconds since any fixed moment.
    pub fn show_fusion(&mut self, event: FuseEvent, now_s: f64) {
        match event {
            FuseEvent::Progress { stage, done, of } => {
                let (unit, stage) = match stage {
                    Stage::Look => ("view", "measuring depths"),
                    Stage::Find => ("view", "finding surfaces"),
                    Stage::Fuse => ("view", "fusing"),
                    Stage::Write => ("part", "writing"),
                };
                self.show_counted(unit, stage, done, of, now_s);
            }
            FuseEvent::Coarser { wanted_m, voxel_m } => {
                self.notice(&format!("memory is short: voxels of {voxel_m:.3} m instead of {wanted_m:.3} m"))
            }
        }
    }

    /// Prints a line to standard error at once; a bar stays below the line.
    pub fn notice(&self, line: &str) {
        let shown = match self.display {
            Display::Bars => {
                self.bar.println(line);
                Ok(())
            }
            Display::Lines | Display::Json => writeln!(io::stderr(), "{line}"),
        };
        let _ = shown; // write errors are ignored: the task goes on
    }

    /// Removes the bar.
    pub fn finish(self) {
        self.bar.finish_and_clear();
    }
}
