//! What a client sees first in a report: what and where the model is, how exact it is, the model to walk through, and the
//! files beside the report.
//!
//! What it knows nothing about: how the model was made.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use cosurf_geo::{DroneResiduals, Geodetic, Georeference, PointResidual, Residuals};
use serde::Deserialize;
use time::OffsetDateTime;

use super::embed::{Captioned, base64};
use super::frame::{self, group_digits};
use super::svg::escape;
use crate::viewer::{self, Walkable};

/// The files that may lie beside a report, with what a client can do with them.
const FILES: [(&str, &str); 19] = [
    ("survey/ortho.tif", "the site from straight above, as a map"),
    ("survey/dsm.tif", "heights of the highest surface, as a map"),
    ("survey/dtm.tif", "heights of the bare ground, as a map"),
    ("survey/confidence.tif", "how exact the heights are, as a map"),
    ("survey/contours.geojson", "lines of equal height"),
    ("survey/points.laz", "the surface as a cloud of points"),
    ("survey/mesh.glb", "the surface as triangles, for viewers"),
    (
        "survey/mesh.obj",
        "the surface as triangles with the coordinates of the maps, for CAD and mesh programs",
    ),
    ("survey/mesh.mtl", "names the picture of the triangles for CAD and mesh programs"),
    ("survey/mesh.jpg", "the picture of the triangles for CAD and mesh programs"),
    ("survey/tileset.json", "the surface as 3D Tiles, for globes such as CesiumJS"),
    ("survey/splats/tileset.json", "the splats as 3D Tiles, for globes such as CesiumJS"),
    ("survey/splats.ply", "the splats with how many photographs see each, for splat viewers"),
    ("survey/accuracy.json", "what the maps are, and how exact, for programs"),
    ("mesh.ply", "the surface as triangles, for CAD and mesh programs"),
    ("global.ply", "the model as splats, for splat viewers"),
    ("geo.json", "the place on the earth, and residuals of GPS and control points"),
    (FIGURES, "all figures, for programs"),
    ("cameras.json", "the places of the photographs"),
];

/// The file with the figures of a report. It is written after the page, so that it tells that the page is whole.
const FIGURES: &str = "report.json";

/// What a client's part is made of.
pub(crate) struct Client {
    /// The folder of the report.
    folder: PathBuf,
    georeference: Option<Georeference>,
    /// The model for the viewer, or why there is none.
    model: Result<Walkable, String>,
    /// The whole model from above; absent if it could not be rendered.
    overview: Option<Captioned>,
}

impl Client {
    /// A client's part of the report in `folder`.
    pub(crate) fn new(
        folder: &Path,
        georeference: Option<Georeference>,
        model: Result<Walkable, String>,
        overview: Option<Captioned>,
    ) -> Self {
        Self { folder: folder.into(), georeference, model, overview }
    }
}

/// The client's part of a page: the first part of its body. `title` is the name of the site or mission.
pub(super) fn section(client: &Client, title: &str) -> String {
    let mut html = format!("<header><h1>{}</h1>\n", escape(title));
    let place = client.georeference.as_ref().map(|georeference| place(&georeference.origin));
    let line: Vec<String> = place.into_iter().chain(date_of(&client.folder)).collect();
    let _ = writeln!(html, "<p class=\"soft\">{}</p></header>", line.join(" · "));
    html.push_str(&figures(client));
    html.push_str(&walk(client));
    html.push_str(&accuracy(client.georeference.as_ref()));
    html.push_str(&files(client));
    html
}

/// The end of a page: the model and the viewer's script; empty without a model.
pub(super) fn script(client: &Client) -> String {
    client.model.as_ref().map_or_else(|_| String::new(), |model| viewer::embedded(model, base64))
}

fn figures(client: &Client) -> String {
    let model = client.model.as_ref().ok();
    // Only a georeferenced model is known to be in metres.
    let metric = model.filter(|_| client.georeference.is_some());
    frame::tiles([
        (metric.and_then(Walkable::area).map(area_text), "between the photographs"),
        (metric.and_then(Walkable::pixel).map(|m| format!("{:.1} cm", 100.0 * m)), "ground sample distance"),
        (model.map(|model| group_digits(model.shown()[1])), "splats"),
    ])
}

fn area_text(m2: f64) -> String {
    if m2 < 10_000.0 { format!("{m2:.0} m²") } else { format!("{:.1} ha", m2 / 10_000.0) }
}

fn place(origin: &Geodetic) -> String {
    let side = |degrees: f64, names: [&str; 2]| {
        format!("{:.5}° {}", degrees.abs(), names[usize::from(degrees < 0.0)])
    };
    format!("{}, {}", side(origin.latitude_deg, ["N", "S"]), side(origin.longitude_deg, ["E", "W"]))
}

/// The day on which the global model was written, UTC.
fn date_of(folder: &Path) -> Option<String> {
    let modified = folder.join("global.ply").metadata().ok()?.modified().ok()?;
    let seconds = modified.duration_since(UNIX_EPOCH).ok()?.as_secs();
    let date = OffsetDateTime::from_unix_timestamp(i64::try_from(seconds).ok()?).ok()?.date();
    Some(format!("{}-{:02}-{:02}", date.year(), u8::from(date.month()), date.day()))
}

/// The overview and the viewer.
fn walk(client: &Client) -> String {
    let mut html = String::new();
    if let Some(Captioned { caption, size_px: [width, height], uri }) = &client.overview {
        let _ = writeln!(
            html,
            "<figure class=\"overview\"><img src=\"{uri}\" width=\"{width}\" height=\"{height}\" alt=\"{caption}\"></figure>"
        );
    }
    match &client.model {
        Ok(model) => {
            let [shown, of] = model.shown();
            let _ = write!(html, "<h2>Walk through the model</h2>\n{}", viewer::SECTION);
            if shown < of {
                let _ = writeln!(
                    html,
                    "<p class=\"soft\">To keep this page small, the viewer shows {} of {} splats, the most important \
                     ones. <code>global.ply</code> has all.</p>",
                    group_digits(shown),
                    group_digits(of)
                );
            }
        }
        Err(reason) => html.push_str(&frame::remarks(&[format!("no model to walk through: {reason}")])),
    }
    html
}

/// The residuals of GPS, control and check points in a table; empty without a georeference.
fn accuracy(georeference: Option<&Georeference>) -> String {
    let Some(georeference) = georeference else { return String::new() };
    let mut html = String::from("<h2>Accuracy</h2>\n");
    let drones = georeference.clone().take_residuals("");
    if drones.is_empty() {
        return html + "<p>The place was given by hand; nothing was measured against it.</p>\n";
    }
    html.push_str(&frame::scroll("Accuracy"));
    html.push_str(
        "<table class=\"plain\"><thead><tr><th>root mean square of residuals</th><th>number</th>\
         <th>horizontal</th><th>vertical</th></tr></thead><tbody>\n",
    );
    for drone in &drones {
        push_rows(&mut html, drone);
    }
    html + "</tbody></table></div>\n<p class=\"soft\">Check points took no part in the fit: their residuals are the \
            measured accuracy.</p>\n"
}

/// Adds the rows of a drone; those of a model that was not merged from several have no drone's name.
fn push_rows(html: &mut String, DroneResiduals { name, residuals }: &DroneResiduals) {
    let whose = match name.trim_start_matches('/') {
        "" => String::new(),
        name => format!(" of {}", escape(name)),
    };
    let Residuals { gps, control, check, .. } = residuals;
    if let Some(gps) = gps {
        let name = format!("GPS{whose}");
        let _ = writeln!(html, "{}", row(&name, gps.agreeing, gps.horizontal_rms_m, gps.vertical_rms_m));
    }
    for (what, points) in [("control points", control), ("check points", check)] {
        if !points.is_empty() {
            let [east, north, up] = PointResidual::rms_m(points);
            let _ = writeln!(html, "{}", row(&format!("{what}{whose}"), points.len(), east.hypot(north), up));
        }
    }
}

fn row(name: &str, count: usize, horizontal_m: f64, vertical_m: f64) -> String {
    format!("<tr><td>{name}</td><td>{count}</td><td>{horizontal_m:.3} m</td><td>{vertical_m:.3} m</td></tr>")
}

/// Links to the files that lie beside the report.
fn files(client: &Client) -> String {
    // A survey whose accuracy.json is missing is incomplete, or of an earlier model.
    let is_there = |name: &str| name == FIGURES || client.folder.join(name).is_file();
    let is_whole = |name: &str| !name.starts_with("survey/") || is_there("survey/accuracy.json");
    let mut html = String::from("<h2>Files</h2>\n<ul class=\"files\">");
    for (name, what) in FILES.into_iter().filter(|(name, _)| is_there(name) && is_whole(name)) {
        let _ = write!(html, "<li><a href=\"{name}\">{name}</a> {what}</li>");
    }
    html += "</ul>\n";
    if let Some(heights) = heights(&client.folder) {
        let _ = writeln!(html, "<p class=\"soft\">Heights of maps and points are {}.</p>", escape(&heights));
    }
    html
}

/// What the heights of the survey are, as it tells itself.
fn heights(folder: &Path) -> Option<String> {
    #[derive(Deserialize)]
    struct Told {
        heights: String,
    }
    let bytes = cosurf_scene::files::read(&folder.join("survey/accuracy.json")).ok()?;
    serde_json::from_slice(&bytes).ok().map(|told: Told| told.heights)
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use cosurf_geo::GpsResiduals;
    use cosurf_scene::{LocalFrame, Picture, ply};

    use super::*;
    use crate::testing::ground;
    use crate::viewer::Room;

    /// A client's part without a model, of a folder without files.
    pub(crate) fn without_model() -> Client {
        Client::new(Path::new("no such folder"), None, Err("too <small>".into()), None)
    }

    /// Eight of nine photographs agree.
    fn by_gps() -> Residuals {
        let gps = GpsResiduals {
            photographs: 9,
            with_accuracy: 0,
            agreeing: 8,
            horizontal_rms_m: 1.25,
            vertical_rms_m: 2.5,
        };
        Residuals { gps: Some(gps), ..Residuals::default() }
    }

    #[test]
    fn a_client_sees_place_accuracy_files_and_the_model() {
        let folder = tempfile::tempdir().unwrap();
        ply::write(&folder.path().join("global.ply"), &ground(0.0, 50.0), &LocalFrame::WORLD).unwrap();
        let origin = Geodetic { latitude_deg: -33.5, longitude_deg: 16.4, height_m: 70.0 };
        let residuals = by_gps();
        let georeference = Georeference { residuals, ..Georeference::at(origin).unwrap() };
        let model = Walkable::read(folder.path(), Room::UNLIMITED).map_err(|error| error.to_string());
        let picture = Captioned::new("the model from above", &Picture::new([2, 2], vec![9; 12])).unwrap();
        let client = Client::new(folder.path(), Some(georeference), model, Some(picture));
        let (html, script) = (section(&client, "a<b"), script(&client));
        for part in [
            "<h1>a&lt;b</h1>",
            "33.50000° S, 16.40000° E · 20",
            "1.250 m",
            "href=\"global.ply\"",
            "href=\"report.json\"",
            "class=\"viewer\"",
        ] {
            assert!(html.contains(part), "{part}: {html}");
        }
        assert!(!html.contains("mesh.ply"), "a file that is not there has no link");
        fs::create_dir(folder.path().join("survey")).unwrap();
        fs::write(folder.path().join("survey/dsm.tif"), "a map").unwrap();
        assert!(!section(&client, "x").contains("dsm.tif"), "the survey is incomplete");
        let told = r#"{"heights": "metres above the geoid of a<b.gtx"}"#;
        fs::write(folder.path().join("survey/accuracy.json"), told).unwrap();
        assert!(
            section(&client, "x")
                .contains("Heights of maps and points are metres above the geoid of a&lt;b.gtx.")
        );
        assert!(section(&client, "x").contains("href=\"survey/dsm.tif\""));
        assert!(script.contains("id=\"viewer-model\">H4sI") && script.contains("startViewer"));
    }

    #[test]
    fn residuals_of_merged_drones_are_told_with_their_names() {
        let residuals = by_gps();
        let drone = |name: &str| DroneResiduals { name: name.into(), residuals: residuals.clone() };
        let origin = cosurf_geo::Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 };
        let drones = vec![drone("east"), drone("<west>")];
        let html = accuracy(Some(&Georeference { drones, ..Georeference::at(origin).unwrap() }));
        assert!(html.contains("<td>GPS of east</td><td>8</td><td>1.250 m</td>"), "{html}");
        assert!(html.contains("GPS of &lt;west&gt;") && !html.contains("by hand"), "{html}");
        let html = accuracy(Some(&Georeference { residuals, ..Georeference::at(origin).unwrap() }));
        assert!(html.contains("<td>GPS</td>"), "{html}");
    }

    #[test]
    fn without_a_model_the_reason_is_told_and_no_script_runs() {
        let client = without_model();
        assert!(section(&client, "x").contains("no model to walk through: too &lt;small&gt;"));
        assert_eq!(script(&client), "");
    }
}
