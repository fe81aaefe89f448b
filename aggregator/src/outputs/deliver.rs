//! Runs a survey, and shows its progress.
//!
//! What it knows nothing about: what a survey makes.

use std::time::Duration;

use crate::survey::{Accuracy, SurveyError, SurveyEvent, SurveyOrder, survey};
use crate::terminal::{Display, Meter};

/// Makes the deliverables of a model. `now` returns the time since any fixed moment.
pub fn deliver(
    order: &SurveyOrder,
    display: Display,
    now: impl Fn() -> Duration,
) -> Result<Accuracy, SurveyError> {
    let mut meter = Meter::new(display);
    let accuracy = survey(order, |event| {
        let now_s = now().as_secs_f64();
        match event {
            SurveyEvent::Fusion(event) => meter.show_fusion(event, now_s),
            SurveyEvent::Counted { what, stage, done, of } => {
                meter.show_counted(what, stage, done, of, now_s)
            }
        }
    });
    meter.finish();
    accuracy
}
