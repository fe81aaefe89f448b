//! Tests of the poses and intrinsics that several tools write, and of files that are refused.

#![allow(clippy::unwrap_used)]

use std::fs;

use serde_json::{Value, json};

use super::*;
use crate::Dataset;

/// A temporary folder with two pictures of 8 × 6 pixels, in which each test writes its
/// `transforms.json`.
struct Scene(tempfile::TempDir);

impl Scene {
    fn new() -> Self {
        let scene = Self(tempfile::tempdir().unwrap());
        fs::create_dir(scene.0.path().join("images")).unwrap();
        for name in ["images/b.png", "images/a.jpg.png"] {
            Picture::new([8, 6], vec![9; 144]).write_png(&scene.0.path().join(name)).unwrap();
        }
        scene
    }

    fn open(&self, transforms: &Value) -> Result<Dataset, SceneError> {
        self.open_text(transforms.to_string().as_bytes())
    }

    fn open_text(&self, text: &[u8]) -> Result<Dataset, SceneError> {
        let path = self.0.path().join("transforms.json");
        let _ = fs::remove_file(&path);
        fs::write(path, text).unwrap();
        Dataset::open(self.0.path())
    }

    fn complaint(&self, transforms: &Value) -> String {
        let text = self.open(transforms).unwrap_err().to_string();
        assert!(!text.contains('\n'), "{text}");
        text
    }
}

/// The pose of a camera at (1, 2, 3) that looks along the world's +y, with +z up. Of OpenGL's camera
/// axes, x (right) is the world's +x, y (up) is +z, and z (backward) is -y.
fn looking_along_y() -> Value {
    json!([[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
}

fn nerfstudio() -> Value {
    json!({
        "w": 8, "h": 6, "fl_x": 10.5, "fl_y": 11, "cx": 3.5, "cy": 3.25,
        "k1": 0.0, "k2": 0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV",
        "applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
        "frames": [
            { "file_path": "images/b.png", "transform_matrix": looking_along_y(), "colmap_im_id": 7 },
            { "file_path": "./images/a.jpg", "transform_matrix": looking_along_y(), "fl_x": 20.0 },
        ],
    })
}

#[test]
fn nerfstudio_is_read() {
    let scene = Scene::new();
    let dataset = scene.open(&nerfstudio()).unwrap();
    let names: Vec<&str> = dataset.views.iter().map(|view| &view.name[..]).collect();
    assert_eq!(names, ["images/a.jpg", "images/b.png"]);
    assert!(dataset.views[0].path.ends_with("images/a.jpg.png"), "the extension was found");
    let camera = dataset.views[1].camera;
    assert_eq!((camera.focal_px, camera.center_px), (DVec2::new(10.5, 11.0), DVec2::new(3.5, 3.25)));
    assert_eq!(camera.size_px, [8, 6]);
    assert_eq!(dataset.views[0].camera.focal_px, DVec2::new(20.0, 11.0), "a frame's own value comes first");
    let pose = camera.cam_from_world;
    assert!(pose.center().abs_diff_eq(DVec3::new(1.0, 2.0, 3.0), 1e-12));
    assert!(pose.forward().abs_diff_eq(DVec3::Y, 1e-12));
    // The picture's y axis points down, so a point that is higher in the world has a smaller y. A
    // point further along the world's x is further right.
    assert!(pose.transform(DVec3::new(1.0, 9.0, 5.0)).abs_diff_eq(DVec3::new(0.0, -2.0, 7.0), 1e-12));
    assert!(pose.transform(DVec3::new(4.0, 9.0, 3.0)).abs_diff_eq(DVec3::new(3.0, 0.0, 7.0), 1e-12));
}

#[test]
fn an_angle_of_instant_ngp_gives_the_focal_length() {
    let scene = Scene::new();
    let transforms = json!({
        "camera_angle_x": 2.0 * (0.5_f64).atan(), "aabb_scale": 16,
        "frames": [{ "file_path": "images/b", "transform_matrix": looking_along_y(), "sharpness": 3.5 }],
    });
    let camera = scene.open(&transforms).unwrap().views[0].camera;
    assert_eq!((camera.size_px, camera.center_px), ([8, 6], DVec2::new(4.0, 3.0)));
    assert!(camera.focal_px.abs_diff_eq(DVec2::splat(8.0), 1e-12), "{}", camera.focal_px);
}

#[test]
fn the_path_of_the_file_can_be_opened() {
    let scene = Scene::new();
    let dataset = scene.open(&nerfstudio()).unwrap();
    fs::rename(scene.0.path().join("transforms.json"), scene.0.path().join("other.json")).unwrap();
    assert_eq!(Dataset::open(&scene.0.path().join("other.json")).unwrap(), dataset);
}

#[test]
fn the_sparse_cloud_is_read() {
    let scene = Scene::new();
    let mut transforms = nerfstudio();
    transforms["ply_file_path"] = "sparse_pc.ply".into();
    assert!(scene.complaint(&transforms).contains("sparse_pc.ply: there is no such file"));
    let cloud = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
        property uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n1 2.5 3 4 5 6\n";
    fs::write(scene.0.path().join("sparse_pc.ply"), cloud).unwrap();
    let points = scene.open(&transforms).unwrap().points;
    assert_eq!((points[0].position, points[0].rgb), (DVec3::new(1.0, 2.5, 3.0), [4, 5, 6]));
}

#[test]
fn unusable_values_are_refused_with_a_reason() {
    let scene = Scene::new();
    let with = |key: &str, value: Value| {
        let mut transforms = nerfstudio();
        transforms[key] = value;
        transforms
    };
    let with_matrix = |matrix: Value| {
        let mut transforms = nerfstudio();
        transforms["frames"][1]["transform_matrix"] = matrix;
        transforms
    };
    let scaled = json!([[2, 0, 0, 1], [0, 0, -2, 2], [0, 2, 0, 3], [0, 0, 0, 1]]);
    let mirrored = json!([[-1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]);
    let projective = json!([[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 1, 1]]);
    for (transforms, said) in [
        (with("k1", json!(-0.02)), "is distorted; undistort the pictures with `cosurf-agent ingest"),
        (with("p2", json!(1e-9)), "is distorted"),
        (with("camera_model", json!("OPENCV_FISHEYE")), "is distorted"),
        (with("is_fisheye", json!(true)), "is distorted"),
        (with("camera_model", json!("EQUIRECTANGULAR")), "EQUIRECTANGULAR is not supported"),
        (with("k4", json!(0.1)), "k4 is not supported"),
        (with("fl_x", json!(-3.0)), "frame images/b.png: the focal length"),
        (with("fl_x", json!(null)), "neither fl_x nor camera_angle_x"),
        (with("w", json!(0)), "the picture size 0 × 6 pixels"),
        (with("w", json!(8.5)), "the picture size 8.5 × 6 pixels"),
        (with("frames", json!([])), "no pictures with poses"),
        (with("frames", json!(3)), "is not a valid transforms.json"),
        (with_matrix(scaled), "frame ./images/a.jpg: transform_matrix is not a rotation"),
        (with_matrix(mirrored), "not a rotation"),
        (with_matrix(projective), "does not end with the row 0 0 0 1"),
        (with_matrix(json!([[1, 0, 0, 1], [0, 0, -1, 2]])), "fewer than 3 rows"),
        (with_matrix(json!([[1, 0, 0, 1e300], [0, 0, -1, "x"]])), "is not a valid transforms.json"),
    ] {
        let text = scene.complaint(&transforms);
        assert!(text.contains(said), "{said}: {text}");
    }
}

#[test]
fn missing_pictures_are_named() {
    let scene = Scene::new();
    let mut transforms = nerfstudio();
    transforms["frames"][0]["file_path"] = "images/c.png".into();
    let text = scene.complaint(&transforms);
    assert!(text.contains("images/c.png: this picture is missing, and 0 more"), "{text}");
    transforms["w"] = Value::Null;
    let text = scene.complaint(&transforms);
    assert!(text.contains("w and h are not given") && text.contains("images/c.png"), "{text}");
}

#[test]
fn a_file_cut_anywhere_is_refused() {
    let scene = Scene::new();
    let whole = nerfstudio().to_string();
    for length in 0..whole.len() {
        assert!(scene.open_text(&whole.as_bytes()[..length]).is_err(), "cut to {length}");
    }
}
