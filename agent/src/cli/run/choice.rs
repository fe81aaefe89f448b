//! Chooses the pictures to train on, and the world frame: by the configuration, and by the site's plan.

use std::path::Path;

use anyhow::{Result, bail};
use cosurf_agent::cell::split_by_cell;
use cosurf_agent::session::{Split, TrainPlan, open_dataset};
use cosurf_agent::{checkpoint, outputs};
use cosurf_contract::{AgentConfig, AgentEvent, ChosenBy};
use cosurf_link::PlannedCell;
use cosurf_scene::files;
use cosurf_wire::FrameId;
use serde::{Deserialize, Serialize};

/// The aggregator's answer about the plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Answer {
    /// The world frame of the site.
    pub(super) frame: FrameId,
    /// The agent's cell; `None` if the plan has none for the agent.
    pub(super) cell: Option<PlannedCell>,
}

/// The answer that a training was begun with, in `plan.json`; `None` if no training was begun in the folder `out`, or if
/// an earlier version of the program has begun it. The inner value is `None` if no answer had arrived in time.
pub(super) fn begun_with(out: &Path) -> Option<Option<Answer>> {
    let has_begun = checkpoint::path(out).is_file();
    let text = has_begun.then(|| files::read(&out.join("plan.json")).ok()).flatten()?;
    serde_json::from_slice(&text).ok()
}

/// Keeps the answer that a training begins with, so that it resumes with the same pictures whether or not the aggregator
/// is there. What is no file is set aside.
pub(super) fn keep(out: &Path, answer: Option<&Answer>) -> Result<()> {
    let path = out.join("plan.json");
    files::set_aside_unless_file(&path)?;
    outputs::write_json(&path, &answer)
}

/// The world frame that the configuration and the answer agree on.
pub(super) fn frame(config: &AgentConfig, answer: Option<&Answer>) -> Result<FrameId> {
    match (config.frame, answer) {
        (Some(own), Some(answer)) if own != answer.frame => bail!(
            "`frame` is {own} in the agent's configuration, and {} at the aggregator: set the same `frame` on both sides",
            answer.frame
        ),
        (Some(own), _) => Ok(own),
        (None, answer) => Ok(answer.map(|answer| answer.frame).unwrap_or_default()),
    }
}

/// Chooses the views: those that the configuration names, or else those of the agent's cell, or else all. Sets them in
/// `plan`, and returns the event that tells the choice.
pub(super) fn choose(plan: &mut TrainPlan, answer: Option<&Answer>, resumed: bool) -> Result<AgentEvent> {
    let dataset = open_dataset(plan)?.dataset;
    let of = dataset.views.len();
    let cell = answer.map(|answer| answer.cell.as_ref());
    let by = match (&plan.split, cell) {
        (Split::Named { .. }, _) => ChosenBy::Configuration,
        (Split::Every(every), Some(Some(cell))) => {
            plan.split = split_by_cell(&dataset, cell, *every)?;
            ChosenBy::Cell
        }
        (Split::Every(_), Some(None)) => ChosenBy::NoCell,
        (Split::Every(_), None) => ChosenBy::NoPlan,
    };
    let pictures = match &plan.split {
        Split::Named { train, held_out } => train.len() + held_out.len(),
        Split::Every(_) => of,
    };
    Ok(AgentEvent::ViewsChosen { by, pictures, of, resumed: resumed && by != ChosenBy::Configuration })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use cosurf_wire::VerticalAxis;

    use super::*;

    fn answer(frame: &str) -> Answer {
        let corners = vec![[0.1, 1.0 / 3.0], [1e7, 0.0], [0.0, -7.25]];
        let cell = PlannedCell { vertical: VerticalAxis::Z, corners, margin: 0.2 };
        Answer { frame: FrameId::new(frame).unwrap(), cell: Some(cell) }
    }

    fn config(lines: &str) -> AgentConfig {
        AgentConfig::from_toml(&format!("site = \"s\"\nbroker = \"b\"\n{lines}")).unwrap()
    }

    #[test]
    fn the_frame_is_that_of_both_sides() {
        let name = |lines: &str, answer: Option<&Answer>| {
            frame(&config(lines), answer).map(|frame| frame.to_string()).map_err(|error| error.to_string())
        };
        let enu = answer("enu");
        assert_eq!(name("", None).unwrap(), "local");
        assert_eq!(name("", Some(&enu)).unwrap(), "enu");
        assert_eq!(name("frame = \"utm\"", None).unwrap(), "utm");
        assert_eq!(name("frame = \"enu\"", Some(&enu)).unwrap(), "enu");
        let error = name("frame = \"utm\"", Some(&enu)).unwrap_err();
        assert!(error.contains("utm") && error.contains("enu") && error.contains("both sides"), "{error}");
    }

    #[test]
    fn a_training_resumes_with_the_answer_that_it_was_begun_with() {
        let out = tempfile::tempdir().unwrap();
        let out = out.path();
        keep(out, Some(&answer("enu"))).unwrap();
        assert_eq!(begun_with(out), None, "no training was begun");
        fs::create_dir(out.join("checkpoint")).unwrap();
        fs::write(checkpoint::path(out), "").unwrap();
        assert_eq!(begun_with(out), Some(Some(answer("enu"))));
        keep(out, None).unwrap();
        assert_eq!(begun_with(out), Some(None));
        fs::write(out.join("plan.json"), "torn").unwrap();
        assert_eq!(begun_with(out), None);
        fs::remove_file(out.join("plan.json")).unwrap();
        fs::create_dir(out.join("plan.json")).unwrap();
        keep(out, Some(&answer("enu"))).unwrap();
        assert_eq!(begun_with(out), Some(Some(answer("enu"))));
    }
}
