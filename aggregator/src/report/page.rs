//! Writes `report.html`: one self-contained file, for phone and desktop. The only script is that of the viewer.

use std::fmt::Write;

use cosurf_scene::bytes::format_bytes;

use super::client::{self, Client};
use super::figures::MissionReport;
use super::frame::group_digits;
use super::rows::{depth_normal_text, depth_text, lpips_text, normal_text, rows};
use super::showcase::Showcase;
use super::svg::{dot, escape};
use super::texts::{merge_texts, phases_text, remarks};
use super::{chart, fits, frame, map};
use crate::evaluate::Quality;
use crate::partition::{AssignedView, Cell};
use crate::terminal::format_seconds;
use cosurf_contract::counted;

/// What the page draws in addition to the figures of the report.
pub(crate) struct Drawings<'a> {
    /// The client's part.
    pub(crate) client: &'a Client,
    /// The cells of the agents: cell `i` belongs to agent `i` of the report.
    pub(crate) cells: &'a [Cell],
    /// All views, those trained on and those held out.
    pub(crate) views: &'a [AssignedView],
    /// A few held-out views as pictures.
    pub(crate) showcases: &'a [Showcase],
}

/// Returns the whole page as HTML.
pub(crate) fn page(report: &MissionReport, drawings: &Drawings) -> String {
    let mut html = frame::open("cosurf mission");
    let title = report.data.file_name().map_or("mission".into(), |name| name.to_string_lossy());
    html.push_str(&client::section(drawings.client, &title));
    header(&mut html, report);
    agents(&mut html, report);
    pictures(&mut html, drawings.showcases);
    ground(&mut html, report, drawings);
    html.push_str(&fits::section(report, drawings.cells));
    html.push_str(&frame::footer(report.whole.revision, report.whole.mesh));
    html.push_str(&client::script(drawings.client));
    html + "</body></html>\n"
}

fn header(html: &mut String, report: &MissionReport) {
    let whole = &report.whole;
    let _ = write!(
        html,
        "<h2>The mission</h2>\n<p class=\"soft\">{} over <code>{}</code>, seed {}</p>\n",
        counted(report.agents.len(), "agent"),
        escape(&report.data.file_name().unwrap_or_default().to_string_lossy()),
        report.seed
    );
    let quality = |text: fn(&Quality) -> Option<String>| whole.quality.as_ref().and_then(text);
    html.push_str(&frame::tiles([
        (quality(|q| Some(format!("{:.2} dB", q.psnr))).or(Some("–".into())), "PSNR, held-out views"),
        (quality(|q| Some(format!("{:.3}", q.ssim))).or(Some("–".into())), "SSIM, held-out views"),
        (quality(lpips_text), "LPIPS (VGG)"),
        (quality(depth_text), "median error of depth"),
        (quality(normal_text), "median error of normals"),
        (quality(depth_normal_text), "median error of the normals of depth"),
        (Some(group_digits(whole.splats)), "splats"),
        (whole.mesh.map(|mesh| group_digits(mesh.triangles)), "triangles of the mesh"),
        (Some(format_seconds(whole.seconds)), "from start to report"),
        (Some(format_bytes(whole.bytes_sent)), "sent by the agents"),
        (Some(format_bytes(whole.peak_memory_bytes)), "peak memory of an agent"),
    ]));
}

fn agents(html: &mut String, report: &MissionReport) {
    let _ = write!(html, "<h2>Agents</h2>\n{}<table><thead><tr>", frame::scroll("Agents"));
    let lines = rows(report);
    let (headings, rows) = lines.split_first().expect("headings");
    for heading in headings {
        let _ = write!(html, "<th>{heading}</th>");
    }
    html.push_str("</tr></thead><tbody>\n");
    for (i, row) in rows.iter().enumerate() {
        html.push_str("<tr>");
        for (column, cell) in row.iter().enumerate() {
            let agent = report.agents.get(i).filter(|_| column == 0);
            let dot = agent.map_or_else(String::new, |agent| dot(&agent.device));
            let _ = write!(html, "<td>{dot}{}</td>", escape(cell));
        }
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody></table></div>\n");
    explanation(html, report.whole.quality.as_ref());
    for text in merge_texts(report).into_iter().chain(phases_text(report)) {
        let _ = write!(html, "<p>{}</p>", escape(&text));
    }
    html.push_str(&frame::remarks(&remarks(report)));
}

/// Writes what the columns of the table mean.
fn explanation(html: &mut String, quality: Option<&Quality>) {
    html.push_str(
        "<p class=\"soft\">Views: training views + held-out views. PSNR and SSIM are means over held-out views: in an \
         agent's row, of its own model on its own views; in the last row, of the global model on all views. “In \
         global” is the global model's PSNR on the agent's held-out views. Memory is the peak of a process; the last \
         row shows the largest agent's.",
    );
    if quality.is_some_and(|quality| quality.lpips.is_some()) {
        html.push_str(" LPIPS is that of the global model, by VGG.");
    }
    if let Some(surface) = quality.and_then(|quality| quality.surface) {
        let _ = write!(
            html,
            " Depth and normal are the global model's median errors over the {:.1} % of the true surface's pixels \
             that it covers; the error of depth is in percent of the true depth.",
            100.0 * surface.coverage
        );
    }
    html.push_str("</p>\n");
}

fn pictures(html: &mut String, showcases: &[Showcase]) {
    if showcases.is_empty() {
        return;
    }
    html.push_str("<h2>Held-out views: photograph and global model</h2>\n");
    for showcase in showcases {
        let name = escape(&showcase.name);
        let _ = write!(
            html,
            "<div class=\"view\"><div><b>{name}</b> <span class=\"soft\">{}</span></div>",
            figures(&showcase.quality)
        );
        html.push_str(&frame::strip(&name, &showcase.pictures));
        html.push_str("</div>\n");
    }
}

/// The figures of a view in one line.
fn figures(quality: &Quality) -> String {
    let lpips = lpips_text(quality).map(|text| format!("LPIPS {text}"));
    let depth = depth_text(quality).map(|text| format!("depth error {text}"));
    let normal = normal_text(quality).map(|text| format!("normal error {text}"));
    let mut line = format!("{:.2} dB, SSIM {:.3}", quality.psnr, quality.ssim);
    for figure in [lpips, depth, normal].into_iter().flatten() {
        let _ = write!(line, ", {figure}");
    }
    line
}

fn ground(html: &mut String, report: &MissionReport, drawings: &Drawings) {
    html.push_str("<div class=\"pair\"><section><h2>Cells and views</h2>\n");
    let devices: Vec<&str> = report.agents.iter().map(|agent| &*agent.device).collect();
    html.push_str(&map::draw(drawings.cells, drawings.views, &devices));
    html.push_str("<p class=\"soft\">");
    for device in devices {
        let _ = write!(html, "{}{} &ensp;", dot(device), escape(device));
    }
    html.push_str("Dot: footprint centre of a training view; ring: that of a held-out view.</p></section>\n");
    let curves = report.agents.iter().map(|agent| (&*agent.device, agent.curve.points()));
    let curves: Vec<(&str, &[[f32; 2]])> = curves.collect();
    if let Some(svg) = chart::draw(&curves) {
        let _ = write!(
            html,
            "<section><h2>Training</h2>\n{svg}\
             <p class=\"soft\">PSNR in dB, mean over the latest training pictures.</p></section>"
        );
    }
    html.push_str("</div>\n");
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Picture;

    use super::super::embed::Captioned;
    use glam::DVec2;

    use super::*;
    use cosurf_scene::Outline;

    use crate::partition::Cell;

    fn example_page() -> String {
        let cells = [Cell::new(vec![0], Outline::rectangle([DVec2::ZERO, DVec2::ONE]))];
        let report = super::super::texts::tests::example();
        let grey = Picture::new([2, 2], vec![99; 12]);
        let picture = |caption: &str| Captioned::new(caption, &grey).unwrap();
        let showcase = Showcase {
            name: "a<b>.jpg".into(),
            quality: report.whole.quality.unwrap(),
            pictures: ["truth", "colour", "depth", "normal"].map(picture).into(),
        };
        let client = super::super::client::tests::without_model();
        page(&report, &Drawings { client: &client, cells: &cells, views: &[], showcases: &[showcase] })
    }

    #[test]
    fn the_page_loads_nothing_from_outside() {
        let html = example_page();
        for outside in ["http:", "https:", "<script", "<link", "@import", "url("] {
            assert!(!html.contains(outside), "{outside}");
        }
        assert_eq!(html.matches("src=\"data:image/jpeg;base64,").count(), 4);
        assert_eq!(html.matches("src=").count(), 4);
    }

    #[test]
    fn the_page_has_the_figures_and_escapes_outside_text() {
        let html = example_page();
        for part in [
            "22.00 dB",
            "12\u{202f}345",
            "24.50 dB",
            "0.250",
            "0.42 %",
            "12.3°",
            "the 99.0 %",
            "no images in &lt;x&gt; &amp; &quot;y&quot;",
            "a&lt;b&gt;.jpg",
        ] {
            assert!(html.contains(part), "{part}");
        }
        assert!(!html.contains("<x>") && !html.contains("<b>.jpg"));
    }

    #[test]
    fn every_tag_that_opens_closes() {
        let html = example_page();
        for tag in ["div", "p", "table", "tr", "td", "section", "figure", "svg", "ul", "li", "span", "h2"] {
            let opened =
                html.matches(&format!("<{tag}>")).count() + html.matches(&format!("<{tag} ")).count();
            assert_eq!(opened, html.matches(&format!("</{tag}>")).count(), "{tag}");
        }
    }
}
