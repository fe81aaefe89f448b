//! The report of a service on its newest revision: figures (`report.json`) and a page (`report.html`). A service has no
//! photographs, so the report shows what the models have in common, and renders the global model.

use std::fmt::Write;

use cosurf_contract::counted;
use cosurf_engine::Rendering;
use cosurf_scene::{Cast, Picture, colormap};
use image::ImageError;
use serde::{Deserialize, Serialize};

use super::client::{self, Client};
use super::embed::Captioned;
use super::figures::MeshSummary;
use super::fits;
use super::frame::{self, group_digits};
use super::svg::{dot, escape};
use super::texts::{merge_remarks, merge_text};
use crate::merge::LocalSummary;
use crate::service::{FitRecord, Merging};
use crate::terminal::format_seconds;

/// The figures of a revision; the content of a service's `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SiteReport {
    /// Name of the site.
    pub site: String,
    /// Number of cameras of the global model.
    pub cameras: usize,
    /// The mesh; absent if there is none.
    pub mesh: Option<MeshSummary>,
    /// BLAKE3 hash of `mesh.ply`; absent if there is none.
    pub mesh_blake3: Option<String>,
    /// Why there is no mesh; absent if there is one.
    pub mesh_failure: Option<String>,
    /// Why there are no pictures; absent if there are some.
    #[serde(default)]
    pub pictures_failure: Option<String>,
    /// How the models were merged.
    pub merging: Merging,
}

/// What the global model shows from one of its cameras.
pub(crate) struct SitePicture(Vec<Captioned>);

impl SitePicture {
    /// `unit` is the length of the rendering's unit, metres.
    pub(crate) fn of(rendering: &Rendering, mesh: Option<Cast>, unit: f64) -> Result<Self, ImageError> {
        let size_px = rendering.size_px;
        let range = colormap::depth_range(&rendering.depth);
        let [near_m, far_m] = range.map(|depth| depth * unit as f32);
        let mut pictures = vec![
            Captioned::new("colour", &Picture::from_unit(size_px, &rendering.rgb))?,
            Captioned::new(
                format!("depth, {near_m:.1} (bright) to {far_m:.1} m"),
                &colormap::depth_picture(&rendering.depth, size_px, range),
            )?,
            Captioned::new("normal", &colormap::normal_picture(&rendering.normal, size_px))?,
        ];
        if let Some(mesh) = mesh {
            pictures.push(Captioned::new("mesh", &colormap::clay_picture(&mesh.normals, size_px))?);
        }
        Ok(Self(pictures))
    }
}

/// Returns the whole page as HTML.
pub(crate) fn site_page(report: &SiteReport, pictures: &[SitePicture], client: &Client) -> String {
    let SiteReport { site, cameras, mesh, mesh_blake3: _, mesh_failure, pictures_failure, merging } = report;
    let mut html = frame::open("cosurf site");
    html.push_str(&client::section(client, site));
    let _ = writeln!(
        html,
        "<h2>The site</h2>\n<p class=\"soft\">Revision {} of the global model, merged from {}</p>",
        merging.revision,
        counted(merging.inputs.len() - merging.kept_out.len(), "model"),
    );
    html.push_str(&frame::tiles([
        (Some(group_digits(merging.summary.splats)), "splats"),
        (mesh.map(|mesh| group_digits(mesh.triangles)), "triangles of the mesh"),
        (mesh.map(|mesh| format!("{:.3} m", mesh.voxel_m)), "voxels of the mesh"),
        (Some(group_digits(*cameras)), "cameras"),
        (Some(format_seconds(merging.seconds)), "to merge"),
    ]));
    models(&mut html, merging);
    let failure = mesh_failure.iter().map(|failure| format!("no mesh: {failure}"));
    let unseen = pictures_failure.iter().map(|failure| format!("no pictures: {failure}"));
    html.push_str(&frame::remarks(&merge_remarks(merging).chain(failure).chain(unseen).collect::<Vec<_>>()));
    if !pictures.is_empty() {
        html.push_str("<h2>The global model from some of its cameras</h2>\n");
    }
    for SitePicture(pictures) in pictures {
        let _ = writeln!(html, "<div class=\"view\">{}</div>", frame::strip("global model", pictures));
    }
    let fits: Vec<&FitRecord> = merging.fits.iter().collect();
    if !fits.is_empty() {
        let _ = write!(html, "<h2>How the models fit each other</h2>\n{}", fits::table(&fits));
    }
    html.push_str(&frame::footer(merging.revision, *mesh));
    html.push_str(&client::script(client));
    html + "</body></html>\n"
}

/// The table of the models.
fn models(html: &mut String, merging: &Merging) {
    let _ = write!(html, "<h2>Models</h2>\n{}", frame::scroll("Models"));
    html.push_str(
        "<table class=\"plain\"><thead><tr><th>device</th><th>model</th>\
         <th>splats</th><th>seen better by others</th></tr></thead><tbody>\n",
    );
    for (input, local) in merging.locals() {
        let none = || "–".to_owned();
        let part = || [input.part_splats.map_or_else(none, |splats| splats.to_string()), none()];
        let whole =
            |LocalSummary { arrived, removed, .. }: &LocalSummary| [arrived.to_string(), removed.to_string()];
        let [splats, removed] = match merging.is_kept_out(input) {
            true => ["kept out".into(), none()],
            false => local.map_or_else(part, whole),
        };
        let _ = writeln!(
            html,
            "<tr><td>{}{}</td><td>{}</td><td>{splats}</td><td>{removed}</td></tr>",
            dot(&input.device),
            escape(&input.device),
            input.model
        );
    }
    let _ = writeln!(html, "</tbody></table></div>\n<p>{}</p>", escape(&merge_text(merging)));
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Picture;

    use super::super::texts::tests::merging;
    use super::*;

    fn page(report: &SiteReport) -> String {
        let picture = Captioned::new("colour", &Picture::new([2, 2], vec![99; 12])).unwrap();
        site_page(report, &[SitePicture(vec![picture])], &super::super::client::tests::without_model())
    }

    #[test]
    fn the_page_has_the_figures_escapes_outside_text_and_loads_nothing_from_outside() {
        let mesh = Some(MeshSummary { triangles: 12_345, voxel_m: 0.25 });
        let input = serde_json::from_str(r#"{"device":"agent-1","model":3,"blake3":""}"#).unwrap();
        let merging = Merging { inputs: vec![input], ..merging() };
        let mesh_blake3 = Some(String::new());
        let site = "a<b".into();
        let (mesh_failure, pictures_failure) = (None, None);
        let report =
            SiteReport { site, cameras: 7, mesh, mesh_blake3, mesh_failure, pictures_failure, merging };
        let html = page(&report);
        for part in ["a&lt;b", "12\u{202f}345", "0.250 m", "<b>7</b>", "agent-1", "data:image/jpeg;base64,"] {
            assert!(html.contains(part), "{part}");
        }
        let dot = format!("background:{}\"></span>agent-1", crate::colors::device_css("agent-1"));
        assert!(html.contains(&dot), "{html}");
        for outside in ["a<b", "http:", "https:", "<script", "<link", "@import", "url("] {
            assert!(!html.contains(outside), "{outside}");
        }
        for tag in ["div", "p", "table", "tr", "td", "figure", "ul", "li", "span", "h2"] {
            let opened =
                html.matches(&format!("<{tag}>")).count() + html.matches(&format!("<{tag} ")).count();
            assert_eq!(opened, html.matches(&format!("</{tag}>")).count(), "{tag}");
        }
        let failed = SiteReport {
            mesh: None,
            mesh_failure: Some("no surface".into()),
            pictures_failure: Some("too large".into()),
            ..report.clone()
        };
        let failed = page(&failed);
        for remark in ["<li>no mesh: no surface</li>", "<li>no pictures: too large</li>"] {
            assert!(failed.contains(remark), "{failed}");
        }
        let text = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<SiteReport>(&text).unwrap(), report);
    }
}
