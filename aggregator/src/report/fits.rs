//! Shows how well the models of every two agents fit each other, as a table and on a map.

use std::fmt::Write;

use super::figures::MissionReport;
use super::svg::escape;
use super::{frame, map};
use crate::partition::Cell;
use crate::service::FitRecord;

/// The section about the fits, as HTML; empty if no fit was measured.
pub(super) fn section(report: &MissionReport, cells: &[Cell]) -> String {
    let merges = report.edges.iter().map(|edge| &edge.merging).chain([&report.whole.merging]);
    let fits: Vec<&FitRecord> = merges.flatten().flat_map(|merging| &merging.fits).collect();
    if fits.is_empty() {
        return String::new();
    }
    let agent = |device: &String| report.agents.iter().position(|agent| agent.device == *device);
    let between_agents = |fit: &&FitRecord| match fit.devices.each_ref().map(agent) {
        [Some(one), Some(other)] => Some(([one, other], fit.after_px)),
        _ => None,
    };
    let lines: Vec<([usize; 2], f64)> = fits.iter().filter_map(between_agents).collect();
    let mut html = String::from("<h2>How the models fit each other</h2>\n<div class=\"pair\"><section>\n");
    html.push_str(&table(&fits));
    html.push_str("</section>\n<section>");
    let devices: Vec<&str> = report.agents.iter().map(|agent| &*agent.device).collect();
    html.push_str(&map::draw_fits(cells, &lines, &devices));
    html.push_str("<p class=\"soft\">Distance in pixels, as the models were merged.</p></section></div>\n");
    html
}

/// The table of the fits, with what its columns mean, as HTML.
pub(super) fn table(fits: &[&FitRecord]) -> String {
    let mut html = frame::scroll("How the models fit each other");
    html.push_str(
        "<table class=\"plain\"><thead><tr><th>models</th><th>points</th><th>arrived, px</th>\
         <th>merged, px</th></tr></thead><tbody>\n",
    );
    for FitRecord { devices: [one, other], points, before_px, after_px } in fits {
        let (one, other) = (escape(one), escape(other));
        let _ = writeln!(
            html,
            "<tr><td>{one} – {other}</td><td>{points}</td><td>{before_px:.2}</td><td>{after_px:.2}</td></tr>"
        );
    }
    html.push_str(
        "</tbody></table></div>\n<p class=\"soft\">Points of the ground that both models show, and the median distance \
         between a point in one model and in the other, as the models arrived and as they were merged; pixels of \
         pictures with a long side of 320 px.</p>\n",
    );
    html
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use glam::DVec2;

    use super::super::texts::tests::{example, merging};
    use super::*;
    use cosurf_scene::Outline;

    #[test]
    fn every_fit_has_a_row_and_those_of_two_agents_a_line_on_the_map() {
        let cell = |west: f64| {
            Cell::new(Vec::new(), Outline::rectangle([DVec2::new(west, 0.0), DVec2::new(west + 50.0, 50.0)]))
        };
        let cells = [cell(0.0), cell(50.0)];
        let mut report = example();
        assert_eq!(section(&report, &cells), "");
        let fit = |one: &str, other: &str| FitRecord {
            devices: [one.into(), other.into()],
            points: 123,
            before_px: 4.5,
            after_px: 0.625,
        };
        let fits = vec![fit("agent-1", "agent-2"), fit("agent-1", "a<b")];
        report.whole.merging = Some(crate::service::Merging { fits, ..merging() });
        let html = section(&report, &cells);
        assert_eq!((html.matches("<tr>").count(), html.matches("<line").count()), (3, 1), "{html}");
        assert!(html.contains("<td>agent-1 – agent-2</td><td>123</td><td>4.50</td><td>0.62</td>"), "{html}");
        assert!(html.contains(">0.62</text>") && html.contains("a&lt;b"), "{html}");
    }
}
