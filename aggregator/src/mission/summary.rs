//! Computes the figures of a mission from the statuses of its agents.

use cosurf_wire::ModelHeader;

use super::board::{Phase, Status};
use super::plan::{Plan, Settings};
use crate::evaluate::Quality;
use crate::report::{AgentSummary, MissionReport, WholeSummary};

/// Makes the report from the agents' statuses and the global model's scores. `qualities` are the scores of the held-out
/// views, in the order of the views; none if the model was not scored. The caller fills in durations, mesh, merges, edges, the score of the
/// joined models, the survey, and the aggregators' memory.
pub(crate) fn summarize(
    plan: &Plan,
    settings: &Settings,
    board: &[Status],
    global: &ModelHeader,
    qualities: &[Quality],
) -> MissionReport {
    let held_out: Vec<usize> = plan.views.iter().filter(|view| view.held_out).map(|view| view.cell).collect();
    let agent = |(i, status): (usize, &Status)| {
        let its = held_out.iter().zip(qualities).filter(|(cell, _)| **cell == i);
        let qualities: Vec<Quality> = its.map(|(_, quality)| *quality).collect();
        let held_out = held_out.iter().filter(|cell| **cell == i).count();
        AgentSummary {
            device: plan.devices[i].to_string(),
            views: plan.cells[i].views.len() + plan.cells[i].guests.len(),
            held_out,
            training: status.training.clone(),
            bytes_sent: status.bytes_sent,
            restarts: status.restarts,
            in_global: Quality::mean(&qualities),
            failure: match &status.phase {
                Phase::Failed { reason } => Some(reason.clone()),
                _ => None,
            },
            // The agent's own has the beginning too, if the mission was started again.
            curve: status.training.as_ref().map_or(&status.curve, |training| &training.curve).clone(),
        }
    };
    let agents: Vec<AgentSummary> = board.iter().enumerate().map(agent).collect();
    let trainings = || agents.iter().filter_map(|agent| agent.training.as_ref());
    let steps = trainings().map(|training| u64::from(training.steps)).sum();
    let longest_s = trainings().map(|training| training.seconds).fold(0.0, f64::max);
    let whole = WholeSummary {
        views: plan.views.len() - held_out.len(),
        held_out: held_out.len(),
        splats: global.splats as usize,
        revision: global.model.0,
        steps,
        seconds: 0.0,
        steps_per_s: if longest_s > 0.0 { steps as f64 / longest_s } else { 0.0 },
        peak_memory_bytes: trainings().map(|training| training.peak_memory_bytes).max().unwrap_or(0),
        aggregator_peak_memory_bytes: None,
        bytes_sent: agents.iter().map(|agent| agent.bytes_sent).sum(),
        quality: Quality::mean(qualities),
        joined: None,
        merging: None,
        mesh: None,
        mesh_failure: None,
        scores_failure: None,
        survey_failure: None,
        phases: Vec::new(),
    };
    MissionReport { data: settings.data.clone(), seed: settings.seed, agents, edges: Vec::new(), whole }
}
