//! Photographs of the synthetic city become a dataset with real COLMAP.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use cosurf_city::{City, CitySettings, RawSettings};
use cosurf_scene::colmap::{self, Form};
use cosurf_scene::{Dataset, View};
use cosurf_tests::programs::program;
use cosurf_tests::skips::skip;

/// Twelve photographs of a small place.
const CITY: CitySettings = CitySettings { seed: 3, extent_m: 40.0, views: 12, size_px: [400, 300] };
/// Largest error of a camera's place: GPS here is a quarter of a metre off along each axis.
const OFF_MAX_M: f64 = 1.0;

/// The true poses.
fn truth(photographs: &Path) -> Vec<View> {
    let read = |name: &str| fs::read(photographs.join("gt/sparse/0").join(name)).unwrap();
    let files = [read("cameras.bin"), read("images.bin"), read("points3D.bin")];
    colmap::parse(Form::Binary, [&files[0], &files[1], &files[2]]).unwrap().views
}

#[test]
fn photographs_get_the_poses_they_were_taken_from() {
    if Command::new("colmap").arg("help").stdout(Stdio::null()).stderr(Stdio::null()).status().is_err() {
        return skip("REQUIRE_COLMAP", "colmap is not installed");
    }
    let folder = tempfile::tempdir().unwrap();
    let (photographs, data) = (folder.path().join("photographs"), folder.path().join("data"));
    let settings = RawSettings { gps_noise_m: 0.25, gps_bias_m: 0.0, targets: 0, ..RawSettings::default() };
    City::build(&CITY).unwrap().write_raw(&settings, &photographs, |_, _| ()).unwrap();
    let origin = settings.origin;
    let run = Command::new(program("cosurf-agent"))
        .args(["ingest", "--origin"])
        .arg(format!("{},{},{}", origin.latitude_deg, origin.longitude_deg, origin.height_m))
        .arg("--out")
        .args([&data, &photographs])
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let made = Dataset::open(&data).unwrap().views;
    assert!(made.len() >= 10, "{} of 12 photographs have poses", made.len());
    let truth = truth(&photographs);
    for view in &made {
        let true_view = truth.iter().find(|other| other.name == view.name).unwrap();
        let [is, was] = [view, true_view].map(|view| view.camera.cam_from_world);
        let (off_m, turned) = (is.center().distance(was.center()), is.forward().angle_between(was.forward()));
        assert!(off_m < OFF_MAX_M && turned.to_degrees() < 1.0, "{}: {off_m} m, {turned} rad", view.name);
    }
}
