//! What all pages are made of: the head, figures in tiles, remarks, and strips of pictures.

use std::fmt::Write;

use super::embed::Captioned;
use super::figures::MeshSummary;
use super::svg::escape;
use crate::viewer;

/// What a page may load: nothing that is not in it. The viewer's worker is made of its script, as `blob:`.
const POLICY: &str = "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; \
                      script-src 'unsafe-inline'; worker-src blob:; base-uri 'none'; form-action 'none'";

/// The beginning of a page with this title, up to its body.
pub(super) fn open(title: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\">\
         <title>{title}</title>\n<style>{}{}</style></head><body>\n",
        include_str!("page.css"),
        viewer::STYLE
    )
}

/// Figures with their labels; those that are `None` are left out.
pub(super) fn tiles<const N: usize>(figures: [(Option<String>, &str); N]) -> String {
    let mut html = String::from("<div class=\"tiles\">");
    for (value, label) in figures {
        let Some(value) = value else { continue };
        let _ = write!(html, "<div class=\"tile\"><b>{value}</b><span>{label}</span></div>");
    }
    html + "</div>\n"
}

/// The beginning of a box for a table that may be wider than the page. The keyboard reaches it, so that it can be scrolled.
pub(super) fn scroll(label: &str) -> String {
    format!("<div class=\"scroll\" role=\"region\" tabindex=\"0\" aria-label=\"{label}\">")
}

/// A list of remarks; empty if there are none.
pub(super) fn remarks(remarks: &[String]) -> String {
    if remarks.is_empty() {
        return String::new();
    }
    let items = remarks.iter().map(|remark| format!("<li>{}</li>", escape(remark)));
    format!("<ul class=\"remarks\">{}</ul>\n", items.collect::<String>())
}

/// Pictures of one view side by side. `name` is the view's, as HTML.
pub(super) fn strip(name: &str, pictures: &[Captioned]) -> String {
    let columns = if pictures.len() > 6 { 4 } else { 3 };
    let mut html = format!("<div class=\"strip\" style=\"--columns:{columns}\">");
    for Captioned { caption, size_px: [width, height], uri } in pictures {
        let _ = write!(
            html,
            "<figure><img src=\"{uri}\" width=\"{width}\" height=\"{height}\" alt=\"{name}: {caption}\">\
             <figcaption>{caption}</figcaption></figure>"
        );
    }
    html + "</div>"
}

/// The end of a page: what the files beside it are.
pub(super) fn footer(revision: u64, mesh: Option<MeshSummary>) -> String {
    let mesh = mesh.map_or(String::new(), |mesh| {
        format!(
            "<code>mesh.ply</code> is its surface, fused from the depth that all cameras see, in voxels of {:.2} m. ",
            mesh.voxel_m
        )
    });
    format!(
        "<h2>The model</h2>\n<p><code>global.ply</code> beside this file is revision {revision} of the global model in \
         the standard 3DGS layout, which every splat viewer opens. {mesh}<code>report.json</code> has these figures for \
         scripts.</p>\n"
    )
}

/// Formats `1234567` as `1 234 567`, with narrow spaces at which a browser does not break the line.
pub(super) fn group_digits(count: usize) -> String {
    let digits = count.to_string();
    let mut grouped = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            grouped.push('\u{202f}');
        }
        grouped.push(digit);
    }
    grouped
}
