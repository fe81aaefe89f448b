//! The rows of the table of agents, which the page and the terminal share.

use cosurf_contract::TrainReport;
use cosurf_scene::bytes::format_bytes;

use super::figures::{AgentSummary, MissionReport, WholeSummary};
use crate::evaluate::Quality;
use crate::terminal::format_seconds;

/// Returns the headings, one row for each agent and one for the whole mission. LPIPS and the errors of
/// depth and normals get no column if the mission did not measure them; other unknown figures are dashes.
pub(crate) fn rows(report: &MissionReport) -> Vec<Vec<String>> {
    let mut headings =
        ["", "views", "splats", "steps", "time", "steps/s", "memory", "sent", "PSNR", "SSIM", "in global"]
            .map(String::from)
            .to_vec();
    let measures = measures(&report.whole);
    headings.extend(measures.iter().map(|(heading, _)| heading.to_string()));
    let mut rows = vec![headings];
    rows.extend(report.agents.iter().map(|agent| agent_row(agent, &measures)));
    rows.push(whole_row(&report.whole, &measures));
    rows
}

/// The heading of a column, and a function that returns a figure of the global model as text, or `None` if
/// the figure is not known.
type Measure = (&'static str, fn(&Quality) -> Option<String>);

/// The columns besides PSNR and SSIM whose figures are known for the global model.
fn measures(whole: &WholeSummary) -> Vec<Measure> {
    let all: [Measure; 4] = [
        ("LPIPS", lpips_text),
        ("depth", depth_text),
        ("normal", normal_text),
        ("normal of depth", depth_normal_text),
    ];
    all.into_iter().filter(|(_, text)| whole.quality.as_ref().and_then(text).is_some()).collect()
}

/// The LPIPS distance by VGG16 as text.
pub(crate) fn lpips_text(quality: &Quality) -> Option<String> {
    quality.lpips.map(|lpips| format!("{:.3}", lpips.vgg))
}

/// The median error of depth as text.
pub(crate) fn depth_text(quality: &Quality) -> Option<String> {
    quality.surface?.depth_error_percent.map(|error| format!("{:.2} %", error.median))
}

/// The median error of the normals of depth, which are computed from the rendered depth, as text.
pub(crate) fn depth_normal_text(quality: &Quality) -> Option<String> {
    quality.surface?.depth_normal_error_deg.map(|error| format!("{:.1}°", error.median))
}

/// The median error of the rendered normals, which are blended from the normals of the splats, as text.
pub(crate) fn normal_text(quality: &Quality) -> Option<String> {
    quality.surface?.normal_error_deg.map(|error| format!("{:.1}°", error.median))
}

fn agent_row(agent: &AgentSummary, measures: &[Measure]) -> Vec<String> {
    let training = agent.training.as_ref();
    let figure =
        |text: &dyn Fn(&TrainReport) -> Option<String>| training.and_then(text).unwrap_or("–".into());
    let mut row = vec![
        agent.device.clone(),
        format_views(agent.views, agent.held_out),
        figure(&|t| Some(t.splats.to_string())),
        figure(&|t| Some(t.steps.to_string())),
        figure(&|t| Some(format_seconds(t.seconds))),
        figure(&|t| Some(format!("{:.1}", t.steps_per_s))),
        figure(&|t| Some(format_bytes(t.peak_memory_bytes))),
        format_bytes(agent.bytes_sent),
        figure(&|t| t.psnr.map(|psnr| format!("{psnr:.2} dB"))),
        figure(&|t| t.ssim.map(|ssim| format!("{ssim:.3}"))),
    ];
    row.extend(in_global(agent.in_global.as_ref(), measures));
    row
}

fn whole_row(whole: &WholeSummary, measures: &[Measure]) -> Vec<String> {
    let figure = |text: fn(Quality) -> String| whole.quality.map_or("–".into(), text);
    let mut row = vec![
        "whole".into(),
        format_views(whole.views, whole.held_out),
        whole.splats.to_string(),
        whole.steps.to_string(),
        format_seconds(whole.seconds),
        format!("{:.1}", whole.steps_per_s),
        format_bytes(whole.peak_memory_bytes),
        format_bytes(whole.bytes_sent),
        figure(|quality| format!("{:.2} dB", quality.psnr)),
        figure(|quality| format!("{:.3}", quality.ssim)),
    ];
    row.extend(in_global(whole.quality.as_ref(), measures));
    row
}

/// The cells of a table row that show the figures of the global model on some views.
fn in_global(quality: Option<&Quality>, measures: &[Measure]) -> Vec<String> {
    let psnr: Measure = ("PSNR", |quality| Some(format!("{:.2} dB", quality.psnr)));
    let cell = |(_, text): &Measure| quality.and_then(text).unwrap_or("–".into());
    [psnr].iter().chain(measures).map(cell).collect()
}

fn format_views(train: usize, held_out: usize) -> String {
    format!("{train} + {held_out}")
}
