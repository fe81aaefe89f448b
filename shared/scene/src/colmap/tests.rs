//! Tests of round trips, of the exact bytes of files, and of damaged or forged models.

#![allow(clippy::unwrap_used)]

use std::fs;

use glam::{DQuat, DVec2, DVec3};

use super::*;
use crate::{Camera, Pose, SparsePoint};

/// A dataset of two pictures by different cameras, and three points. Its values are chosen so that writing and reading
/// them changes none.
fn made_up(root: &Path) -> Dataset {
    let view = |name: &str, wxyz: [f64; 4], focal_px: DVec2| View {
        name: name.into(),
        camera: Camera {
            cam_from_world: Pose {
                rotation: DQuat::from_xyzw(wxyz[1], wxyz[2], wxyz[3], wxyz[0]),
                translation: DVec3::new(0.25, -1.5, 7.0),
            },
            focal_px,
            center_px: DVec2::new(3.5, 2.25),
            size_px: [8, 6],
        },
        path: root.join("images").join(name),
        mask: None,
    };
    let point = |x: f64, rgb, views: &[u32]| SparsePoint {
        position: DVec3::new(x, 0.5, 2.0),
        rgb,
        views: views.into(),
    };
    Dataset {
        views: vec![
            view("a one.jpg", [1.0, 0.0, 0.0, 0.0], DVec2::new(10.0, 11.0)),
            view("b/two.jpg", [0.0, 0.6, 0.0, 0.8], DVec2::new(9.0, 9.0)),
        ],
        points: vec![
            point(0.0, [1, 2, 3], &[0, 1]),
            point(1.0, [255, 0, 9], &[1]),
            point(-1.0, [4, 5, 6], &[]),
        ],
    }
}

const TEXT_CAMERAS: &str =
    "# cameras\n\n7 PINHOLE 8 6 10 11 3.5 2.25\n  9\tSIMPLE_PINHOLE 8 6 9 3.5 2.25  \r\n";
const TEXT_IMAGES: &str = "# images\n5 1 0 0 0 0.25 -1.5 7 7 a one.jpg\n1.5 2.5 3 0.5 2.5 -1\n\
    6 0 0.6 0 0.8 0.25 -1.5 7 9 b/two.jpg\n\n";
const TEXT_POINTS: &str =
    "1 0 0.5 2 1 2 3 0.1 5 0 6 1 5 7\n2 1 0.5 2 255 0 9 -1 6 0 99 4\n3 -1 0.5 2 4 5 6 0\n";

fn write_text(model: &Path, cameras: &str, images: &str, points: &str) {
    fs::write(model.join("cameras.txt"), cameras).unwrap();
    fs::write(model.join("images.txt"), images).unwrap();
    fs::write(model.join("points3D.txt"), points).unwrap();
}

fn read_at(root: &Path) -> Result<Dataset, SceneError> {
    let mut sieve = Sieve::new(usize::MAX);
    let views = read(root, &find_model(root).unwrap(), &mut sieve)?;
    Ok(Dataset { views, points: sieve.end().0 })
}

fn complaint(root: &Path) -> String {
    let text = read_at(root).unwrap_err().to_string();
    assert!(!text.contains('\n'), "{text}");
    text
}

#[test]
fn a_model_survives_the_round_trip() {
    let root = tempfile::tempdir().unwrap();
    let dataset = made_up(root.path());
    write(root.path(), &dataset).unwrap();
    assert_eq!(read_at(root.path()).unwrap(), dataset);
}

#[test]
fn the_text_form_gives_the_same_dataset() {
    let root = tempfile::tempdir().unwrap();
    write_text(root.path(), TEXT_CAMERAS, TEXT_IMAGES, TEXT_POINTS);
    assert_eq!(read_at(root.path()).unwrap(), made_up(root.path()));
    write_text(root.path(), TEXT_CAMERAS, TEXT_IMAGES.trim_end(), "");
    assert_eq!(read_at(root.path()).unwrap().views, made_up(root.path()).views);
}

#[test]
fn quaternions_of_any_length_are_taken() {
    let root = tempfile::tempdir().unwrap();
    write_text(root.path(), TEXT_CAMERAS, &TEXT_IMAGES.replace("0 0.6 0 0.8", "0 -6e3 0 -8e3"), TEXT_POINTS);
    let rotation = read_at(root.path()).unwrap().views[1].camera.cam_from_world.rotation;
    assert!(
        (rotation.length() - 1.0).abs() < 1e-12
            && rotation.dot(DQuat::from_xyzw(0.6, 0.0, 0.8, 0.0)).abs() > 1.0 - 1e-12
    );
}

#[test]
fn files_have_the_bytes_that_colmap_writes() {
    let root = tempfile::tempdir().unwrap();
    let mut dataset = made_up(root.path());
    dataset.views.truncate(1);
    dataset.points.truncate(1);
    dataset.points[0].views = vec![0];
    write(root.path(), &dataset).unwrap();
    let file = |name: &str| fs::read(root.path().join("sparse/0").join(name)).unwrap();
    let f64s = |values: &[f64]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let u64s = |values: &[u64]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let camera =
        [&u64s(&[1])[..], &[1, 0, 0, 0, 1, 0, 0, 0], &u64s(&[8, 6]), &f64s(&[10.0, 11.0, 3.5, 2.25])];
    assert_eq!(file("cameras.bin"), camera.concat());
    // The point is at (0.25, -1, 9) in the camera frame.
    let at = [10.0 * 0.25 / 9.0 + 3.5, -11.0 / 9.0 + 2.25];
    let image = [
        &u64s(&[1])[..],
        &[1, 0, 0, 0],
        &f64s(&[1.0, 0.0, 0.0, 0.0, 0.25, -1.5, 7.0]),
        &[1, 0, 0, 0],
        b"a one.jpg\0",
        &u64s(&[1]),
        &f64s(&at),
        &u64s(&[1]),
    ];
    assert_eq!(file("images.bin"), image.concat());
    let point = [
        &u64s(&[1, 1])[..],
        &f64s(&[0.0, 0.5, 2.0]),
        &[1, 2, 3],
        &f64s(&[0.0]),
        &u64s(&[1]),
        &[1, 0, 0, 0, 0, 0, 0, 0],
    ];
    assert_eq!(file("points3D.bin"), point.concat());
}

#[test]
fn equal_cameras_are_written_once() {
    let root = tempfile::tempdir().unwrap();
    let mut dataset = made_up(root.path());
    dataset.views[1].camera.focal_px = dataset.views[0].camera.focal_px;
    write(root.path(), &dataset).unwrap();
    assert_eq!(fs::metadata(root.path().join("sparse/0/cameras.bin")).unwrap().len(), 8 + 56);
    assert_eq!(read_at(root.path()).unwrap(), dataset);
}

#[test]
fn a_distorted_camera_is_refused_with_its_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("it's data");
    let model = root.join("sparse/0");
    fs::create_dir_all(&model).unwrap();
    let command = |images: &str| {
        let at = |path: &str| format!("'{}'", root.join(path).display().to_string().replace('\'', r"'\''"));
        format!(
            "`colmap image_undistorter --image_path {} --input_path {} --output_path {} --output_type COLMAP`",
            at(images),
            at("sparse/0"),
            at("undistorted")
        )
    };
    let cameras = "1 OPENCV 8 6 9 9 4 3 0.1 0 0 0\n";
    write_text(&model, cameras, "", "");
    let text = complaint(&root);
    assert!(
        text.contains("cameras.txt") && text.contains("model OPENCV") && text.contains(&command("images")),
        "{text}"
    );
    // The pictures may also be in a folder `images` beside the model's folder.
    fs::create_dir(root.join("sparse/images")).unwrap();
    assert!(complaint(&root).contains(&command("sparse/images")));
    for (number, name) in [(2_u32, "SIMPLE_RADIAL"), (11, "RAD_TAN_THIN_PRISM_FISHEYE"), (77, "number 77")] {
        let mut cameras = [1_u64.to_le_bytes(), [1, 0, 0, 0, 0, 0, 0, 0], [0; 8], [0; 8]].concat();
        cameras[12..16].copy_from_slice(&number.to_le_bytes());
        cameras.extend([1; 100]);
        fs::write(model.join("cameras.bin"), cameras).unwrap();
        let text = complaint(&root);
        assert!(
            text.contains(&format!("camera model {name} is")) && text.contains("image_undistorter"),
            "{text}"
        );
    }
}

/// Of `SIMPLE_RADIAL`, `RADIAL`, `OPENCV` and `FULL_OPENCV`, by COLMAP's `models.h`.
#[test]
fn lenses_without_distortion_are_pinholes() {
    let root = tempfile::tempdir().unwrap();
    for (line, focal_y) in [
        ("1 SIMPLE_RADIAL 8 6 9 4 3 0", 9.0),
        ("1 RADIAL 8 6 9 4 3 0 0", 9.0),
        ("1 OPENCV 8 6 9 10 4 3 0 0 0 -0", 10.0),
        ("1 FULL_OPENCV 8 6 9 10 4 3 0 0 0 0 0 0 0 0", 10.0),
    ] {
        write_text(root.path(), &format!("{line}\n"), "1 1 0 0 0 0 0 0 1 a.png\n\n", "");
        let camera = Dataset::cameras(root.path()).unwrap()[0];
        assert_eq!(camera.focal_px.to_array(), [9.0, focal_y], "{line}");
        assert_eq!(camera.center_px.to_array(), [4.0, 3.0], "{line}");
    }
}

#[test]
fn invalid_text_is_refused_with_a_reason() {
    let root = tempfile::tempdir().unwrap();
    let root = root.path();
    for (cameras, images, points, said) in [
        ("7 PINHOLE 8 6 10 11 3.5\n", "", "", "cameras.txt: line 1: PINHOLE with 3 parameters"),
        ("7 PINHOLE 0 6 10 11 3.5 2\n", "", "", "0 × 6 pixels is invalid"),
        ("7 PINHOLE 8 9999999 10 11 3.5 2\n", "", "", "8 × 9999999 pixels is invalid"),
        ("7 PINHOLE 8 6 -1 11 3.5 2\n", "", "", "focal length"),
        ("7 PINHOLE 8 6 1 11 nan 2\n", "", "", "focal length"),
        ("7 PINHOLE 8 6 1 inf 3 2\n", "", "", "focal length"),
        ("7 PINHOLE eight 6 1 11 3 2\n", "", "", "the width cannot be 'eight'"),
        ("7\n", "", "", "the camera model is missing"),
        (
            "\n\n7 PINHOLE 8 6 1 1 3 2\n7 PINHOLE 8 6 1 1 3 2\n",
            "",
            "",
            "line 4: the camera id 7 occurs twice",
        ),
        (
            TEXT_CAMERAS,
            "5 1 0 0 0 0 0 7 8 a.jpg\n",
            "",
            "images.txt: line 1: a.jpg refers to the unknown camera 8",
        ),
        (TEXT_CAMERAS, "5 0 0 0 0 0 0 7 7 a.jpg\n", "", "its pose"),
        (TEXT_CAMERAS, "5 1 0 0 0 0 NaN 7 7 a.jpg\n", "", "its pose"),
        (
            TEXT_CAMERAS,
            "5 1 0 0 0 0 0 7 7 a\n\n5 1 0 0 0 0 0 7 7 b\n",
            "",
            "line 3: the image id 5 occurs twice",
        ),
        (TEXT_CAMERAS, "5 1 0 0 0 0 0 7 7\u{e9}\n", "", "camera id cannot be '7\\u{e9}'"),
        (TEXT_CAMERAS, TEXT_IMAGES, "1 0 inf 2 1 2 3 0\n", "points3D.txt: line 1: its position"),
        (TEXT_CAMERAS, TEXT_IMAGES, "1 0 0 2 1 256 3 0\n", "the colour cannot be '256'"),
        (TEXT_CAMERAS, TEXT_IMAGES, "1 0 0 2 1 2 3 0 5\n", "not a list of pairs"),
    ] {
        write_text(root, cameras, images, points);
        let text = complaint(root);
        assert!(text.contains(said), "{said}: {text}");
    }
}

#[test]
fn a_missing_file_is_named_but_the_points_may_be_missing() {
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &made_up(root.path())).unwrap();
    fs::remove_file(root.path().join("sparse/0/points3D.bin")).unwrap();
    let dataset = read_at(root.path()).unwrap();
    assert!(dataset.points.is_empty() && !dataset.views.is_empty());
    fs::remove_file(root.path().join("sparse/0/images.bin")).unwrap();
    assert!(complaint(root.path()).ends_with("sparse/0/images.bin: there is no such file or folder"));
}

#[test]
fn files_cut_anywhere_are_refused() {
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &made_up(root.path())).unwrap();
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = root.path().join("sparse/0").join(name);
        let whole = fs::read(&path).unwrap();
        for length in 0..whole.len() {
            // The old file is removed first, because on some file systems overwriting a file waits
            // for the disk.
            fs::remove_file(&path).unwrap();
            fs::write(&path, &whole[..length]).unwrap();
            let text = complaint(root.path());
            assert!(text.contains(name) && text.contains("cut short"), "{length} bytes: {text}");
        }
        fs::write(&path, &whole).unwrap();
    }
}

#[test]
fn counts_beyond_the_file_are_refused() {
    let root = tempfile::tempdir().unwrap();
    let dataset = made_up(root.path());
    for (name, offset) in [
        ("cameras.bin", 0),
        ("images.bin", 0),
        ("images.bin", 8 + 64 + "a one.jpg\0".len()),
        ("points3D.bin", 0),
        ("points3D.bin", 8 + 43),
    ] {
        write(root.path(), &dataset).unwrap();
        let path = root.path().join("sparse/0").join(name);
        let mut file = fs::read(&path).unwrap();
        for count in [100, 1 << 40, u64::MAX] {
            file[offset..offset + 8].copy_from_slice(&count.to_le_bytes());
            fs::write(&path, &file).unwrap();
            let text = complaint(root.path());
            assert!(text.contains(name) && text.contains(&format!("claims {count} records")), "{text}");
        }
    }
}

#[test]
fn a_flipped_byte_never_panics() {
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &made_up(root.path())).unwrap();
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = root.path().join("sparse/0").join(name);
        let whole = fs::read(&path).unwrap();
        for at in 0..whole.len() {
            let mut file = whole.clone();
            file[at] ^= 0xFF;
            fs::remove_file(&path).unwrap();
            fs::write(&path, &file).unwrap();
            if let Ok(dataset) = read_at(root.path()) {
                assert!(dataset.points.iter().all(|point| point.position.is_finite()));
                assert!(dataset.points.iter().flat_map(|point| &point.views).all(|&view| view < 2));
            }
        }
        fs::write(&path, &whole).unwrap();
    }
}
