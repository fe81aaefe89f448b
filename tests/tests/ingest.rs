//! Photographs of the synthetic city become a dataset with real COLMAP.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use cosurf_city::{City, CitySettings, RawSettings};
use cosurf_scene::colmap::{self, Form};
use cosurf_scene::{Dataset, Picture, View};
use cosurf_tests::programs::program;
use cosurf_tests::skips::skip;

/// Twelve photographs of a small place.
const CITY: CitySettings = CitySettings { seed: 3, extent_m: 40.0, views: 12, size_px: [400, 300] };
/// Largest error of a camera's place: GPS here is a quarter of a metre off along each axis.
const OFF_MAX_M: f64 = 1.0;

/// Whether COLMAP is there; otherwise the test is skipped.
fn has_colmap() -> bool {
    let help = Command::new("colmap").arg("help").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if help.is_err() {
        skip("REQUIRE_COLMAP", "colmap is not installed");
    }
    help.is_ok()
}

/// The true poses.
fn truth(photographs: &Path) -> Vec<View> {
    let read = |name: &str| fs::read(photographs.join("gt/sparse/0").join(name)).unwrap();
    let files = [read("cameras.bin"), read("images.bin"), read("points3D.bin")];
    colmap::parse(Form::Binary, [&files[0], &files[1], &files[2]]).unwrap().views
}

#[test]
fn photographs_get_the_poses_they_were_taken_from() {
    if !has_colmap() {
        return;
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

#[test]
fn photographs_that_are_all_the_same_have_no_poses() {
    if !has_colmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (photographs, data) = (folder.path().join("photographs"), folder.path().join("data"));
    City::build(&CITY).unwrap().write_raw(&RawSettings::default(), &photographs, |_, _| ()).unwrap();
    let same = folder.path().join("same");
    fs::create_dir(&same).unwrap();
    let first = fs::read_dir(&photographs)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .find(|path| path.extension().is_some_and(|end| end == "JPG"))
        .unwrap();
    for i in 0..4 {
        // What follows the end of a JPEG is not read, but makes it no copy, which would be left out.
        let bytes = [&fs::read(&first).unwrap()[..], &[i]].concat();
        fs::write(same.join(format!("{i}.jpg")), bytes).unwrap();
    }
    let run = Command::new(program("cosurf-agent"))
        .args(["ingest", "--out"])
        .args([&data, &same])
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&run.stderr).into_owned();
    let last = told.lines().last().unwrap();
    assert!(!run.status.success() && last.contains("of 4 photographs, fewer than 3"), "{told}");
    assert!(!data.join("sparse").exists(), "nothing half done");
}

#[test]
fn one_command_makes_deliverables_of_photographs() {
    if !has_colmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (photographs, out) = (folder.path().join("photographs"), folder.path().join("out"));
    let settings = RawSettings { gps_noise_m: 0.25, gps_bias_m: 0.0, targets: 9, ..RawSettings::default() };
    City::build(&CITY).unwrap().write_raw(&settings, &photographs, |_, _| ()).unwrap();
    let run = Command::new(program("cosurf-aggregator"))
        .args(["mission", "--agents", "2", "--steps", "60", "--max-size", "200", "--data"])
        .arg(&photographs)
        .arg("--out")
        .arg(&out)
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let made = [
        "dsm.tif",
        "dtm.tif",
        "ortho.tif",
        "confidence.tif",
        "points.laz",
        "mesh.glb",
        "mesh.jpg",
        "tileset.json",
        "splats.ply",
    ];
    for file in made.into_iter().chain(["contours.geojson", "accuracy.json"]) {
        assert!(out.join("survey").join(file).is_file(), "{file} is missing");
    }
    let accuracy = fs::read(out.join("survey/accuracy.json")).unwrap();
    let accuracy: serde_json::Value = serde_json::from_slice(&accuracy).unwrap();
    assert_eq!(accuracy["epsg"], 32_633, "the UTM zone of the photographs' GPS");
    assert!(accuracy["gps"]["horizontal_rms_m"].as_f64().unwrap() < OFF_MAX_M, "{accuracy}");
    // Nearly all of the city's 40 m × 40 m have heights, which lie above the ellipsoid as its ground does.
    assert!(accuracy["covered_m2"].as_f64().unwrap() > 800.0, "{accuracy}");
    let lowest_m = accuracy["height_range_m"][0].as_f64().unwrap();
    assert!((lowest_m - settings.origin.height_m).abs() < 10.0, "{accuracy}");
    check_heights(&photographs, &out.join("survey/dsm.tif"), &accuracy);
}

/// Compares the map at the check points, as GDAL reads it, with where they were measured, and with what the survey claims.
fn check_heights(photographs: &Path, dsm: &Path, accuracy: &serde_json::Value) {
    let check = &accuracy["check"];
    let claimed_m = accuracy["height_error_m"].as_f64().unwrap().hypot(check["rmse_m"][2].as_f64().unwrap());
    let list = fs::read_to_string(photographs.join("gcp_list.txt")).unwrap();
    let points = check["points"].as_array().unwrap();
    let mut squares = Vec::new();
    for point in points {
        let name = point["name"].as_str().unwrap();
        let line = list.lines().find(|line| line.ends_with(name)).unwrap();
        let [east, north, height, ..] = line.split_whitespace().collect::<Vec<_>>()[..] else {
            panic!("{line}")
        };
        let read = Command::new("gdallocationinfo")
            .args(["-valonly", "-geoloc"])
            .arg(dsm)
            .args([east, north])
            .output();
        let Ok(read) = read else { return skip("REQUIRE_GDAL", "gdallocationinfo is not installed") };
        let Ok(read_m) = String::from_utf8(read.stdout).unwrap().trim().parse::<f64>() else { continue };
        // Where nobody sees the ground, there is no height.
        if read_m > -1000.0 {
            squares.push((read_m - height.parse::<f64>().unwrap()).powi(2));
        }
    }
    assert!(!squares.is_empty(), "{check}");
    let rms_m = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    println!(
        "{} of {} check points: off by {rms_m:.3} m, claimed {claimed_m:.3} m",
        squares.len(),
        points.len()
    );
    assert!(rms_m < 2.0 * claimed_m, "off by {rms_m} m, claimed {claimed_m} m: {accuracy}");
}

#[test]
fn what_masks_hide_gets_no_points() {
    if !has_colmap() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let [raw, photographs, data] = ["raw", "photographs", "data"].map(|name| folder.path().join(name));
    let settings = RawSettings { gps_noise_m: 0.25, gps_bias_m: 0.0, targets: 0, ..RawSettings::default() };
    City::build(&CITY).unwrap().write_raw(&settings, &raw, |_, _| ()).unwrap();
    let [images, masks] = ["images", "masks"].map(|name| photographs.join(name));
    fs::create_dir_all(&images).unwrap();
    fs::create_dir_all(&masks).unwrap();
    for file in fs::read_dir(&raw).unwrap().map(|file| file.unwrap().path()) {
        if file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("jpg")) {
            let name = file.file_name().unwrap().to_str().unwrap();
            fs::rename(&file, images.join(name)).unwrap();
            quarter_hidden(CITY.size_px).write_png(&masks.join(format!("{name}.png"))).unwrap();
        }
    }
    let run = Command::new(program("cosurf-agent"))
        .arg("ingest")
        .arg("--out")
        .args([&data, &photographs])
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let Dataset { views, points, .. } = Dataset::open(&data).unwrap();
    assert!(views.len() >= 10 && views.iter().all(|view| view.mask.is_some()), "{} views", views.len());
    let mut seen = [0, 0];
    for (point, view) in points.iter().flat_map(|point| point.views.iter().map(move |view| (point, *view))) {
        let camera = &views[view as usize].camera;
        let Some((px, _)) = camera.project_with_depth(point.position) else { continue };
        // The lens bends the border of the hidden quarter by a few pixels.
        seen[usize::from(px.x < 0.2 * f64::from(camera.size_px[0]))] += 1;
    }
    let [shown, hidden] = seen;
    assert!(shown > 500 && hidden * 100 < shown, "{shown} points are shown, {hidden} hidden");
}

/// A mask whose left quarter hides.
fn quarter_hidden(size_px: [u32; 2]) -> Picture {
    let [width, height] = size_px.map(|side| side as usize);
    let grey = |x: usize| if 4 * x < width { 0.0 } else { 1.0 };
    let rgb: Vec<f32> = (0..width * height).flat_map(|i| [grey(i % width); 3]).collect();
    Picture::from_unit(size_px, &rgb)
}
