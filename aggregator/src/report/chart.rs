//! Draws training curves as SVG: PSNR over steps, one line per agent.

use std::fmt::Write;

use cosurf_contract::counted;

use crate::colors::device_css;

const WIDTH: f32 = 1000.0;
const HEIGHT: f32 = 360.0;
/// Space for the labels on the left and below, SVG units.
const GUTTER: [f32; 2] = [70.0, 40.0];

/// Draws one curve of `[step, dB]` per device; `None` if no curve has two points.
pub(crate) fn draw(curves: &[(&str, &[[f32; 2]])]) -> Option<String> {
    let points = || curves.iter().flat_map(|(_, curve)| curve.iter());
    if curves.iter().all(|(_, curve)| curve.len() < 2) {
        return None;
    }
    let steps = points().map(|point| point[0]).fold(1.0, f32::max);
    let low = points().map(|point| point[1]).fold(f32::MAX, f32::min).floor();
    let high = points().map(|point| point[1]).fold(f32::MIN, f32::max).ceil().max(low + 1.0);
    let x = |step: f32| GUTTER[0] + step / steps * (WIDTH - GUTTER[0] - 10.0);
    let y = |psnr: f32| 10.0 + (high - psnr) / (high - low) * (HEIGHT - GUTTER[1] - 10.0);
    let mut svg = format!(r#"<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="Training curves">"#);
    for tick in 0..=4 {
        let psnr = low + (high - low) * tick as f32 / 4.0;
        let (y, right) = (y(psnr), WIDTH - 10.0);
        let _ = write!(svg, r#"<path d="M{} {y:.1}H{right}" class="grid"/>"#, GUTTER[0]);
        let _ = write!(
            svg,
            r#"<text x="{}" y="{:.1}" text-anchor="end">{psnr:.1}</text>"#,
            GUTTER[0] - 8.0,
            y + 6.0
        );
    }
    for (device, curve) in curves {
        let line: Vec<String> =
            curve.iter().map(|[step, psnr]| format!("{:.1},{:.1}", x(*step), y(*psnr))).collect();
        let color = device_css(device);
        let _ = write!(
            svg,
            r#"<polyline points="{}" fill="none" stroke="{color}" stroke-width="3"/>"#,
            line.join(" ")
        );
    }
    let (base, right, steps) = (HEIGHT - 12.0, WIDTH - 10.0, counted(steps, "step"));
    let _ = write!(svg, r#"<text x="{}" y="{base}">0</text>"#, GUTTER[0]);
    let _ = write!(svg, r#"<text x="{right}" y="{base}" text-anchor="end">{steps}</text></svg>"#);
    Some(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_value_is_highest_and_the_last_step_rightmost() {
        let svg = draw(&[("a", &[[0.0, 10.0], [500.0, 20.0]]), ("b", &[])]).unwrap_or_default();
        assert!(svg.contains(r#"points="70.0,320.0 990.0,10.0""#), "{svg}");
    }

    #[test]
    fn curves_without_two_points_give_no_drawing() {
        assert_eq!(draw(&[("a", &[]), ("b", &[[1.0, 2.0]])]), None);
        assert_eq!(draw(&[]), None);
    }
}
