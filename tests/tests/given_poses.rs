//! Photographs with the poses of Metashape, written here by hand by the formulas of its manual, are undistorted by real COLMAP.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::process::Command;

use cosurf_scene::{Dataset, Picture, Pose};
use cosurf_tests::programs::program;
use cosurf_tests::skips::skip;
use glam::{DMat3, DVec2, DVec3};

const SIZE_PX: [u32; 2] = [400, 300];
const FOCAL_PX: f64 = 330.0;
/// Offset of the principal point from the middle, pixels.
const CENTER_PX: DVec2 = DVec2::new(6.0, -4.0);
/// K1, K2, K3, P1, P2, and K4, P3, P4, B1, B2 of Metashape: terms that COLMAP knows, and all.
const LENSES: [[f64; 10]; 2] = [
    [-0.11, 0.03, -0.004, 0.002, -0.003, 0.0, 0.0, 0.0, 0.0, 0.0],
    [-0.11, 0.03, -0.004, 0.002, -0.003, 0.15, 2.0, -1.0, 3.0, -4.0],
];

/// Where Metashape's *frame* camera shows a point of the camera's frame (manual of Metashape Professional, appendix *Camera
/// models*).
fn shown(lens: [f64; 10], p: DVec3) -> DVec2 {
    let [k1, k2, k3, p1, p2, k4, p3, p4, b1, b2] = lens;
    let DVec2 { x, y } = p.truncate() / p.z;
    let r2 = x * x + y * y;
    let radial = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2 * r2 * r2 + k4 * r2 * r2 * r2 * r2;
    let growth = 1.0 + p3 * r2 + p4 * r2 * r2;
    let bent = DVec2::new(
        x * radial + (p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y) * growth,
        y * radial + (p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y) * growth,
    );
    let affine = DVec2::new(b1 * bent.x + b2 * bent.y, 0.0);
    0.5 * DVec2::from(SIZE_PX.map(f64::from)) + CENTER_PX + FOCAL_PX * bent + affine
}

/// A black picture with a white disc at each position.
fn picture(discs: &[DVec2]) -> Picture {
    let pixel = |i: u32| {
        let center = DVec2::new(f64::from(i % SIZE_PX[0]) + 0.5, f64::from(i / SIZE_PX[0]) + 0.5);
        let distance = discs.iter().map(|disc| disc.distance(center)).fold(f64::INFINITY, f64::min);
        [((4.5 - distance).clamp(0.0, 1.0) * 255.0) as u8; 3]
    };
    Picture::new(SIZE_PX, (0..SIZE_PX[0] * SIZE_PX[1]).flat_map(pixel).collect())
}

/// The middle of the light within 9 pixels of a position.
fn middle_of_light(picture: &Picture, near: DVec2) -> DVec2 {
    let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
    for (i, rgb) in picture.rgb.chunks_exact(3).enumerate() {
        let at = DVec2::new(
            (i as u32 % picture.size_px[0]) as f64 + 0.5,
            (i as u32 / picture.size_px[0]) as f64 + 0.5,
        );
        if at.distance(near) < 9.0 {
            sum += at * f64::from(rgb[0]);
            weight += f64::from(rgb[0]);
        }
    }
    sum / weight
}

#[test]
fn pictures_with_poses_of_metashape_are_undistorted() {
    LENSES.into_iter().for_each(undistorts);
}

fn undistorts(lens: [f64; 10]) {
    if Command::new("colmap").arg("help").output().is_err() {
        return skip("REQUIRE_COLMAP", "colmap is not installed");
    }
    let folder = tempfile::tempdir().unwrap();
    let (photographs, data) = (folder.path().join("photographs"), folder.path().join("data"));
    fs::create_dir(&photographs).unwrap();
    let grid = [-1.0, 0.0, 1.0];
    let points: Vec<DVec3> =
        grid.iter().flat_map(|x| grid.map(|y| DVec3::new(20.0 * x, 14.0 * y, 3.0 * x * y))).collect();
    let mut cameras = String::new();
    for (i, x) in [-4.0, 0.0, 4.0].into_iter().enumerate() {
        let pose = Pose::look_at(
            DVec3::new(x, -1.0, 45.0),
            DVec3::new(0.0, 0.5 * x, 0.0),
            DVec3::new(0.1, 1.0, 0.0),
        );
        let discs: Vec<DVec2> = points.iter().map(|point| shown(lens, pose.transform(*point))).collect();
        picture(&discs).write_jpeg(&photographs.join(format!("DJI {i}.JPG")), 95).unwrap();
        let (r, c) = (DMat3::from_quat(pose.rotation), pose.center());
        let row = |axis: DVec3, at: f64| format!("{} {} {} {at} ", axis.x, axis.y, axis.z);
        // The columns of cam_from_world are the rows of its inverse.
        let matrix = row(r.x_axis, c.x) + &row(r.y_axis, c.y) + &row(r.z_axis, c.z) + "0 0 0 1";
        cameras += &format!(
            r#"<camera id="{i}" sensor_id="0" label="DJI {i}"><transform>{matrix}</transform></camera>"#
        );
    }
    let [k1, k2, k3, p1, p2, k4, p3, p4, b1, b2] = lens;
    let xml = format!(
        r#"<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame"><calibration class="adjusted">
        <resolution width="400" height="300"/><f>{FOCAL_PX}</f><cx>6</cx><cy>-4</cy><k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3>
        <p1>{p1}</p1><p2>{p2}</p2><k4>{k4}</k4><p3>{p3}</p3><p4>{p4}</p4><b1>{b1}</b1><b2>{b2}</b2></calibration></sensor></sensors><cameras>{cameras}</cameras></chunk></document>"#
    );
    fs::write(photographs.join("cameras.xml"), xml).unwrap();
    let header = "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    let rows: String = points.iter().map(|p| format!("{} {} {}\n", p.x, p.y, p.z)).collect();
    fs::write(photographs.join("tie points.ply"), format!("{header}{rows}")).unwrap();
    let run = Command::new(program("cosurf-agent"))
        .args(["ingest", "--out"])
        .args([&data, &photographs])
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let told = String::from_utf8_lossy(&run.stdout).into_owned();
    assert!(told.contains("3 of 3 photographs") && told.contains("the world is that of the poses"), "{told}");

    let Dataset { views, points: start } = Dataset::open(&data).unwrap();
    assert_eq!(start.len(), points.len(), "tie points are the start of a training");
    assert_eq!(views.len(), 3);
    let mut seen = 0;
    for view in &views {
        let picture = Picture::read(&view.path).unwrap();
        for at_px in points.iter().filter_map(|point| view.camera.project(*point)) {
            let [width, height] = view.camera.size_px.map(f64::from);
            if at_px.min_element() < 9.0 || at_px.x > width - 9.0 || at_px.y > height - 9.0 {
                continue;
            }
            let off_px = middle_of_light(&picture, at_px).distance(at_px);
            assert!(off_px < 0.4, "{}: off by {off_px} px at {at_px}", view.name);
            seen += 1;
        }
    }
    assert!(seen > 15, "{seen} discs");
}
