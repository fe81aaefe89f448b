//! Writes the figures of a mission as text: the table for a terminal, sentences on merges, and remarks.

use cosurf_scene::bytes::format_bytes;

use super::figures::{EdgeSummary, MissionReport};
use super::rows::rows;
use crate::merge::UNPROVEN_TOLD;
use crate::service::Merging;
use crate::terminal::{aligned, format_seconds};
use cosurf_contract::counted;

/// The table of the figures for a terminal, followed by the sentences on merges.
pub fn table(report: &MissionReport) -> String {
    let texts = merge_texts(report).into_iter().chain(phases_text(report));
    let sentences: String = texts.map(|text| format!("\n{text}\n")).collect();
    aligned(&rows(report)) + &sentences
}

/// How long the phases took, in one sentence; `None` if nobody measured it.
pub(crate) fn phases_text(report: &MissionReport) -> Option<String> {
    let phases = &report.whole.phases;
    let each: Vec<String> =
        phases.iter().map(|phase| format!("{} {}", phase.phase, format_seconds(phase.seconds))).collect();
    (!each.is_empty()).then(|| format!("What took how long: {}.", each.join(", ")))
}

/// One text on each known merge: first the merges of the edges, then that of the root.
pub(crate) fn merge_texts(report: &MissionReport) -> Vec<String> {
    let whole = &report.whole;
    let merge = |edge: &EdgeSummary| {
        let (merging, sent) = (edge.merging.as_ref()?, format_bytes(edge.bytes_sent));
        Some(format!(
            "{} of {}: {} {sent} sent to the root.",
            edge.device,
            edge.agents.join(", "),
            merge_text(merging)
        ))
    };
    let mut texts: Vec<String> = report.edges.iter().filter_map(merge).collect();
    let Some(merging) = &whole.merging else { return texts };
    let mut last = merge_text(merging);
    if let Some(joined) = whole.joined {
        last += &format!(" Joined but not merged, the agents' models reach {:.2} dB.", joined.psnr);
    }
    let arrived: usize = merging.summary.locals.iter().map(|local| local.arrived).sum();
    let trained =
        report.agents.iter().filter_map(|agent| Some(agent.training.as_ref()?.splats)).sum::<usize>();
    let are_all_here = report.edges.is_empty() && merging.summary.locals.len() == report.agents.len();
    if are_all_here && trained > arrived {
        let dropped = counted(trained - arrived, "splat");
        last += &format!(" Before upload, the agents had dropped {dropped} that others own.");
    }
    texts.push(last);
    texts
}

pub(super) fn merge_text(Merging { summary, seconds, .. }: &Merging) -> String {
    let removed: usize = summary.locals.iter().map(|local| local.removed).sum();
    let (time, removed) = (format_seconds(*seconds), counted(removed, "overlapping splat"));
    let (joined, splats, steps) = (summary.joined, summary.splats, counted(summary.steps, "step"));
    format!("Merged in {time}: {removed} removed, {joined} joined, {splats} after {steps}.")
}

/// One sentence on each thing that a reader should know: failures and restarts of agents, what agents
/// gave up for memory, models that were incomplete, kept out or changed in a merge, and why there is no
/// mesh.
pub(crate) fn remarks(report: &MissionReport) -> Vec<String> {
    let mut remarks = Vec::new();
    for agent in &report.agents {
        let device = &agent.device;
        if let Some(failure) = &agent.failure {
            remarks.push(format!("{device} failed: {failure}"));
        }
        match agent.restarts {
            0 => {}
            1 => remarks.push(format!("{device} died once and resumed from its checkpoint")),
            times => remarks.push(format!("{device} died {times} times and resumed from its checkpoint")),
        }
        let given_up = agent.training.iter().flat_map(|training| &training.given_up);
        remarks.extend(given_up.map(|sentence| format!("{device}: {sentence}")));
        let moved_px = agent.training.as_ref().and_then(|training| training.poses_moved_px);
        remarks.extend(moved_px.map(|moved_px| {
            format!(
                "{device}: the poses were not exact and have been corrected; half of the pictures moved by {moved_px:.1} px or \
                 more, and scores are those at poses found for each view"
            )
        }));
    }
    let merges = report.edges.iter().map(|edge| &edge.merging).chain([&report.whole.merging]);
    merges.flatten().for_each(|merging| remarks.extend(merge_remarks(merging)));
    remarks.extend(report.whole.mesh_failure.iter().map(|failure| format!("no mesh: {failure}")));
    remarks.extend(report.whole.scores_failure.iter().map(|failure| format!("no scores: {failure}")));
    remarks.extend(report.whole.survey_failure.iter().map(|failure| format!("no survey: {failure}")));
    remarks
}

/// One sentence on each model that was incomplete, kept out or changed in a merge.
pub(super) fn merge_remarks(merging: &Merging) -> impl Iterator<Item = String> {
    let parts = merging.inputs.iter().filter_map(|input| {
        let (device, splats) = (&input.device, counted(input.part_splats?, "splat"));
        Some(format!("only {splats} of the model of {device} had arrived when the models were merged"))
    });
    let kept_out = merging.kept_out.iter().map(|kept_out| format!("{kept_out} and is kept out"));
    let unproven = merging.locals().filter_map(|(input, local)| Some((&input.device, local?.unproven)));
    let unproven = unproven.filter(|(_, share)| *share >= UNPROVEN_TOLD).map(|(device, share)| {
        format!(
            "{device}: has few splats where {:.0} % of its cameras look, which do not count",
            100.0 * share
        )
    });
    parts.chain(kept_out).chain(merging.fitted.iter().map(ToString::to_string)).chain(unproven)
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_contract::{Curve, TrainReport};

    use super::super::figures::{AgentSummary, MeshSummary, PhaseTime, WholeSummary};
    use super::*;
    use crate::evaluate::{LpipsScore, Quality, Spread, SurfaceQuality};
    use crate::merge::{LocalSummary, MergeSettings, MergeSummary};

    fn quality(psnr: f64) -> Quality {
        let (depth, normal) = (Spread { median: 0.42, mean: 1.1 }, Spread { median: 12.3, mean: 20.0 });
        let surface = SurfaceQuality {
            coverage: 0.99,
            depth_error_percent: Some(depth),
            normal_error_deg: Some(normal),
            depth_normal_error_deg: Some(normal),
        };
        Quality {
            psnr,
            ssim: 0.7,
            lpips: Some(LpipsScore { vgg: 0.25, alex: 0.125 }),
            surface: Some(surface),
        }
    }

    /// The report of a mission of two agents, one of which failed.
    pub(crate) fn example() -> MissionReport {
        let mut curve = Curve::default();
        [(100, 15.0), (600, 25.0)].into_iter().for_each(|(step, psnr)| curve.push(step, psnr));
        let training = TrainReport {
            steps: 600,
            seconds: 61.0,
            cpu_seconds: 60.0,
            steps_per_s: 9.8,
            splats: 12_345,
            peak_memory_bytes: 200 << 20,
            psnr: Some(24.5),
            ssim: Some(0.8),
            seed: 1,
            device: "cpu".into(),
            views: 10,
            held_out: 2,
            size_px: [320, 240],
            poses_moved_px: Some(0.94),
            given_up: vec!["pictures were shrunk to 160 px".into()],
            curve: curve.clone(),
        };
        let good = AgentSummary {
            device: "agent-1".into(),
            views: 10,
            held_out: 2,
            training: Some(training),
            bytes_sent: 3 << 20,
            restarts: 1,
            in_global: Some(quality(23.0)),
            failure: None,
            curve,
        };
        let failed = AgentSummary {
            device: "agent-2".into(),
            training: None,
            bytes_sent: 0,
            restarts: 0,
            in_global: None,
            failure: Some("no images in <x> & \"y\"".into()),
            curve: Curve::default(),
            ..good.clone()
        };
        MissionReport {
            data: "city".into(),
            seed: 1,
            agents: vec![good, failed],
            edges: Vec::new(),
            whole: WholeSummary {
                views: 20,
                held_out: 4,
                splats: 12_345,
                revision: 1,
                steps: 600,
                seconds: 75.0,
                steps_per_s: 9.8,
                peak_memory_bytes: 200 << 20,
                aggregator_peak_memory_bytes: None,
                bytes_sent: 3 << 20,
                quality: Some(quality(22.0)),
                joined: None,
                merging: None,
                mesh: Some(MeshSummary { triangles: 4321, voxel_m: 0.25 }),
                mesh_failure: None,
                scores_failure: None,
                survey_failure: None,
                phases: Vec::new(),
            },
        }
    }

    #[test]
    fn the_table_is_aligned_and_shows_dashes_for_unknown_figures() {
        let table = table(&example());
        let lines: Vec<&str> = table.lines().collect();
        assert_eq!(lines.len(), 4, "{table}");
        let end_of = |line: &str, cell: &str| line.split(cell).next().unwrap().chars().count() + cell.len();
        assert_eq!(end_of(lines[0], "PSNR"), end_of(lines[1], "24.50 dB"), "{table}");
        assert_eq!(end_of(lines[0], "PSNR"), end_of(lines[3], "22.00 dB"), "{table}");
        assert!(lines[2].starts_with("agent-2") && lines[2].matches('–').count() == 12, "{table}");
        assert!(lines[0].ends_with("LPIPS   depth  normal  normal of depth"), "{table}");
        assert!(lines[3].ends_with("0.250  0.42 %   12.3°            12.3°"), "{table}");
    }

    #[test]
    fn figures_that_were_not_measured_have_no_column() {
        let mut report = example();
        report.whole.quality =
            report.whole.quality.map(|quality| Quality { lpips: None, surface: None, ..quality });
        let table = super::table(&report);
        assert!(table.lines().next().unwrap().ends_with("in global"), "{table}");
        assert!(table.trim_end().ends_with("22.00 dB"), "{table}");
    }

    #[test]
    fn remarks_list_failures_restarts_and_what_was_given_up() {
        let remarks = remarks(&example());
        assert_eq!(remarks.len(), 4, "{remarks:?}");
        assert!(remarks[0].contains("died once") && remarks[1].contains("shrunk"), "{remarks:?}");
        assert!(remarks[2].contains("moved by 0.9 px"), "{remarks:?}");
        assert!(remarks[3].starts_with("agent-2 failed"), "{remarks:?}");
    }

    #[test]
    fn phases_and_a_failed_survey_are_told() {
        let mut report = example();
        let phase = |phase: &str, seconds| PhaseTime { phase: phase.into(), seconds };
        report.whole.phases = vec![phase("mesh", 65.0), phase("survey", 9.0)];
        report.whole.survey_failure = Some("too large".into());
        let table = table(&report);
        assert!(table.ends_with("What took how long: mesh 1 min 05 s, survey 9 s.\n"), "{table}");
        assert_eq!(remarks(&report).last().unwrap(), "no survey: too large");
    }

    /// Of three models, the first is kept out and of the second only a part had arrived. So the figures are those of the
    /// third.
    #[test]
    fn a_model_with_cameras_that_do_not_count_is_told() {
        let input = |device: &str, part: &str| {
            let text = format!(r#"{{"device":"{device}","model":1,"blake3":""{part}}}"#);
            serde_json::from_str(&text).unwrap()
        };
        let out = r#"{"device":"a","model":1,"reason":"contradicts b"}"#;
        let with = |unproven: f64| {
            let mut merging = merging();
            merging.inputs = vec![input("a", ""), input("b", r#","part_splats":3"#), input("c", "")];
            merging.kept_out = vec![serde_json::from_str(out).unwrap()];
            merging.summary.locals = vec![LocalSummary { unproven, ..LocalSummary::default() }];
            merge_remarks(&merging).last().unwrap()
        };
        assert_eq!(with(0.284), "c: has few splats where 28 % of its cameras look, which do not count");
        assert!(with(0.02).contains("kept out"), "honest models have some such cameras: {}", with(0.02));
    }

    /// The record of a merge of seven splats.
    pub(crate) fn merging() -> Merging {
        Merging {
            files_blake3: Default::default(),
            revision: 1,
            inputs: Vec::new(),
            kept_out: Vec::new(),
            fitted: Vec::new(),
            fits: Vec::new(),
            settings: MergeSettings::default(),
            summary: MergeSummary { joined: 7, splats: 6, steps: 5, ..MergeSummary::default() },
            seconds: 12.0,
            restored_from: None,
        }
    }

    #[test]
    fn every_merge_has_its_sentence() {
        let mut report = example();
        let merging = merging();
        report.whole.merging = Some(merging.clone());
        let agents = vec!["agent-1".into(), "agent-2".into()];
        let edge = EdgeSummary { device: "edge-1".into(), agents, bytes_sent: 3 << 20, merging: None };
        report.edges = vec![edge.clone(), EdgeSummary { merging: Some(merging), ..edge }];
        let texts = merge_texts(&report);
        assert_eq!(texts.len(), 2, "an edge that merged nothing has a sentence: {texts:?}");
        assert!(texts[0].starts_with("edge-1 of agent-1, agent-2: Merged in"), "{texts:?}");
        assert!(texts[1].ends_with("7 joined, 6 after 5 steps."), "{texts:?}");
    }

    #[test]
    fn the_report_survives_json() {
        let report = example();
        let json = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<MissionReport>(&json).unwrap(), report);
    }
}
