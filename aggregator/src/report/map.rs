//! Draws the map of a partition as SVG: the cell of every agent, the footprints of the training views, and the
//! centres of all footprints.

use std::fmt::Write;

use glam::DVec2;

use super::svg::escape;
use crate::colors::device_css;
use crate::partition::{AssignedView, Cell};

/// Width of the drawing in SVG units; the page scales it.
const WIDTH: f64 = 1000.0;
/// Margin around the cells, as a share of the longer side of their bounding box. The margin is at least 1 m.
const MARGIN: f64 = 0.15;

/// Draws cells and views. Cell `i` belongs to device `i`.
pub(crate) fn draw(cells: &[Cell], views: &[AssignedView], devices: &[&str]) -> String {
    let color_of = |cell: usize| device_css(devices.get(cell).copied().unwrap_or_default());
    let frame = Frame::around(cells);
    let mut svg = String::new();
    let height = frame.height();
    let _ = write!(
        svg,
        r#"<svg viewBox="0 0 {WIDTH} {height:.0}" role="img" aria-label="Map of the partition">"#
    );
    for view in views.iter().filter(|view| !view.held_out) {
        let points = view.footprint.outline.map(|corner| frame.text(corner)).join(" ");
        let color = color_of(view.cell);
        let _ = write!(
            svg,
            r#"<polygon points="{points}" fill="{color}" fill-opacity=".05" stroke="{color}" stroke-opacity=".15"/>"#
        );
    }
    for (i, cell) in cells.iter().enumerate() {
        draw_cell(&mut svg, &frame, &color_of(i), cell);
    }
    for view in views {
        draw_center(&mut svg, &frame, &color_of(view.cell), view);
    }
    draw_scale(&mut svg, &frame);
    svg.push_str("</svg>");
    svg
}

/// Draws the cells, and a line with a figure between every two devices in `fits`. Cell `i` belongs to device
/// `i`.
pub(super) fn draw_fits(cells: &[Cell], fits: &[([usize; 2], f64)], devices: &[&str]) -> String {
    let frame = Frame::around(cells);
    let height = frame.height();
    let mut svg = format!(
        r#"<svg viewBox="0 0 {WIDTH} {height:.0}" role="img" aria-label="Map of how the models fit each other">"#
    );
    for (i, cell) in cells.iter().enumerate() {
        draw_cell(&mut svg, &frame, &device_css(devices.get(i).copied().unwrap_or_default()), cell);
    }
    let middle = |agent: usize| {
        let corners = cells.get(agent)?.outline.corners();
        Some(frame.place(corners.iter().sum::<DVec2>() / corners.len().max(1) as f64))
    };
    for ([one, other], px) in fits {
        let (Some(a), Some(b)) = (middle(*one), middle(*other)) else { continue };
        // Not in the middle of the line: there, the labels of crossing lines would lie on each other.
        let label = a.lerp(b, 0.4);
        let _ = write!(
            svg,
            r#"<line x1="{:.1}" y1="{:.1}" x2="{:.1}" y2="{:.1}" class="ink"/><text x="{:.1}" y="{:.1}">{px:.2}</text>"#,
            a.x,
            a.y,
            b.x,
            b.y,
            label.x + 8.0,
            label.y - 8.0
        );
    }
    draw_scale(&mut svg, &frame);
    svg.push_str("</svg>");
    svg
}

fn draw_cell(svg: &mut String, frame: &Frame, color: &str, cell: &Cell) {
    let corners: Vec<String> = cell.outline.corners().iter().map(|corner| frame.text(*corner)).collect();
    let points = corners.join(" ");
    let _ = write!(
        svg,
        r#"<polygon points="{points}" fill="{color}" fill-opacity=".12" stroke="{color}" stroke-width="3" stroke-linejoin="round"/>"#
    );
}

fn draw_center(svg: &mut String, frame: &Frame, color: &str, view: &AssignedView) {
    let at = frame.place(view.footprint.center);
    let (fill, what) = if view.held_out { ("none", ", held out") } else { (color, "") };
    let _ = write!(
        svg,
        r#"<circle cx="{:.1}" cy="{:.1}" r="6" fill="{fill}" stroke="{color}" stroke-width="2"><title>{}{what}</title></circle>"#,
        at.x,
        at.y,
        escape(&view.name)
    );
}

/// Draws a scale bar of at most a quarter of the map's width. Its length is 1, 2 or 5 times a power of ten
/// metres.
fn draw_scale(svg: &mut String, frame: &Frame) {
    let length_m = round_length(WIDTH / frame.scale / 4.0);
    let (x, y) = (20.0, frame.height() - 20.0);
    let end = x + length_m * frame.scale;
    let _ = write!(
        svg,
        r#"<path d="M{x} {0:.1}v6H{end:.1}v-6" class="ink"/><text x="{1:.1}" y="{2:.1}">{length_m} m</text>"#,
        y - 6.0,
        x + 8.0,
        y - 8.0
    );
}

fn round_length(about: f64) -> f64 {
    let power = 10f64.powf(about.log10().floor());
    let factor = [5.0, 2.0, 1.0].into_iter().find(|factor| factor * power <= about);
    factor.unwrap_or(1.0) * power
}

/// Converts map coordinates to SVG units, with north up.
struct Frame {
    low: DVec2,
    high: DVec2,
    scale: f64,
}

impl Frame {
    fn around(cells: &[Cell]) -> Self {
        let corners = cells.iter().flat_map(|cell| cell.outline.bounds());
        let (low, high) = corners.fold((DVec2::MAX, DVec2::MIN), |(low, high), p| (low.min(p), high.max(p)));
        let margin = ((high - low).max_element() * MARGIN).max(1.0);
        let (low, high) = (low - margin, high + margin);
        Self { low, high, scale: WIDTH / (high.x - low.x) }
    }

    fn height(&self) -> f64 {
        (self.high.y - self.low.y) * self.scale
    }

    fn place(&self, at: DVec2) -> DVec2 {
        DVec2::new(at.x - self.low.x, self.high.y - at.y) * self.scale
    }

    fn text(&self, at: DVec2) -> String {
        let at = self.place(at);
        format!("{:.0},{:.0}", at.x, at.y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cosurf_scene::Footprint;
    use cosurf_scene::Outline;

    #[test]
    fn the_map_shows_every_cell_and_view_with_north_up() {
        let cell = |low: f64, high: f64| {
            let bounds = [DVec2::new(0.0, low), DVec2::new(100.0, high)];
            Cell::new(Vec::new(), Outline::rectangle(bounds))
        };
        let view = |y: f64, cell, held_out| AssignedView {
            name: format!("<{y}>"),
            footprint: Footprint { center: DVec2::new(50.0, y), outline: [DVec2::ZERO; 4] },
            cell,
            held_out,
        };
        let views = [view(10.0, 0, false), view(90.0, 1, false), view(30.0, 0, true)];
        let svg = draw(&[cell(0.0, 50.0), cell(50.0, 100.0)], &views, &["agent-1", "agent-2"]);
        assert_eq!((svg.matches("<circle").count(), svg.matches("<polygon").count()), (3, 2 + 2));
        // The 100 m of the cells and a margin of 15 m on each side are 1000 units wide, so 1 m is 7.69 units.
        // North (y = 90) is up.
        assert!(svg.contains(r#"cx="500.0" cy="192.3""#) && svg.contains(r#"cy="807.7""#), "{svg}");
        assert!(svg.contains("&lt;10&gt;") && !svg.contains("<10>"), "names are escaped");
        assert!(svg.contains(">20 m<"), "{svg}");
        assert_eq!(
            svg.matches(&device_css("agent-2")).count(),
            6,
            "line and area of the cell, a view and its centre"
        );
    }

    #[test]
    fn a_single_point_has_a_map_too() {
        let cell = Cell::new(vec![0], Outline::rectangle([DVec2::ONE; 2]));
        let svg = draw(&[cell], &[], &["agent-1"]);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }

    #[test]
    fn lengths_are_round() {
        for (about, round) in [(9.9, 5.0), (1.0, 1.0), (0.3, 0.2), (2345.0, 2000.0)] {
            assert!((round_length(about) - round).abs() < 1e-9, "{about}");
        }
    }
}
