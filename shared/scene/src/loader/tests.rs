//! Tests of dataset layouts, of pictures that do not fit their cameras, and of splits and subsets.

#![allow(clippy::unwrap_used)]

use std::fs;

use glam::{DVec2, DVec3};

use super::*;
use crate::{Mask, Pose, SparsePoint};

/// A dataset of three pictures of 8 × 6 pixels and five points, written below `root` in COLMAP's
/// layout. The cameras stand 2 world units apart along x and look along y; the points are 4 world
/// units away in y.
fn made_up(root: &Path) -> Dataset {
    let view = |i: u32| {
        let eye = DVec3::new(2.0 * f64::from(i), 0.0, 0.0);
        let name = format!("{i}.png");
        View {
            camera: Camera {
                cam_from_world: Pose::look_at(eye, eye + DVec3::Y, DVec3::Z),
                focal_px: DVec2::splat(8.0),
                center_px: DVec2::new(4.0, 3.0),
                size_px: [8, 6],
            },
            path: root.join("images").join(&name),
            name,
            mask: None,
        }
    };
    let point = |x: f64, views: &[u32]| SparsePoint {
        position: DVec3::new(x, 4.0, 0.0),
        rgb: [1, 2, 3],
        views: views.into(),
    };
    let dataset = Dataset {
        views: (0..3).map(view).collect(),
        points: vec![
            point(0.0, &[0]),
            point(1.0, &[0, 1]),
            point(3.0, &[1, 2]),
            point(4.0, &[]),
            point(-90.0, &[]),
        ],
    };
    fs::create_dir_all(root.join("images")).unwrap();
    for view in &dataset.views {
        Picture::new([8, 6], vec![9; 144]).write_png(&view.path).unwrap();
    }
    colmap::write(root, &dataset).unwrap();
    dataset
}

fn complaint(root: &Path) -> String {
    let text = Dataset::open(root).unwrap_err().to_string();
    assert!(!text.contains('\n'), "{text}");
    text
}

fn assert_same(a: &Dataset, b: &Dataset) {
    let facts = |dataset: &Dataset| {
        let views = dataset.views.iter().map(|view| (view.name.clone(), view.camera.size_px));
        (views.collect::<Vec<_>>(), dataset.points.clone())
    };
    assert_eq!(facts(a), facts(b));
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!(fs::canonicalize(&a.path).unwrap(), fs::canonicalize(&b.path).unwrap());
        assert!(a.camera.cam_from_world.center().distance(b.camera.cam_from_world.center()) < 1e-12);
    }
}

#[test]
fn a_model_is_found_in_every_layout() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("data");
    let dataset = made_up(&root);
    assert_same(&Dataset::open(&root).unwrap(), &dataset);
    assert_same(&Dataset::open(&root.join("sparse")).unwrap(), &dataset);
    assert_same(&Dataset::open(&root.join("sparse/0")).unwrap(), &dataset);
    // COLMAP's undistorter writes the model to `sparse`, not to `sparse/0`.
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::rename(root.join("sparse/0").join(name), root.join("sparse").join(name)).unwrap();
    }
    assert_same(&Dataset::open(&root).unwrap(), &dataset);
    // The model and the pictures are in one folder.
    for entry in fs::read_dir(root.join("sparse")).unwrap().chain(fs::read_dir(root.join("images")).unwrap())
    {
        let entry = entry.unwrap();
        fs::rename(entry.path(), root.join(entry.file_name())).unwrap();
    }
    let opened = Dataset::open(&root).unwrap();
    assert_eq!(opened.views[2].path, root.join("2.png"));
}

#[test]
fn views_are_sorted_and_tracks_follow() {
    let root = tempfile::tempdir().unwrap();
    let mut dataset = made_up(root.path());
    let sorted = dataset.clone();
    dataset.views.reverse();
    for point in &mut dataset.points {
        point.views.iter_mut().for_each(|view| *view = 2 - *view);
    }
    colmap::write(root.path(), &dataset).unwrap();
    assert_same(&Dataset::open(root.path()).unwrap(), &sorted);
}

#[test]
fn missing_pictures_are_counted_and_the_first_is_named() {
    let root = tempfile::tempdir().unwrap();
    made_up(root.path());
    fs::remove_file(root.path().join("images/1.png")).unwrap();
    fs::remove_file(root.path().join("images/2.png")).unwrap();
    let text = complaint(root.path());
    assert!(text.contains("images/1.png") && text.contains("and 1 more of the dataset's 3"), "{text}");
    fs::remove_dir_all(root.path().join("images")).unwrap();
    let text = complaint(root.path());
    assert!(text.contains("images/0.png") && text.contains("and 2 more"), "{text}");
}

#[test]
fn a_picture_of_another_size_rescales_its_camera() {
    let root = tempfile::tempdir().unwrap();
    let dataset = made_up(root.path());
    Picture::new([16, 12], vec![9; 576]).write_png(&root.path().join("images/1.png")).unwrap();
    // A third of the size is 2.67 × 2 pixels, which a tool rounds to 3 × 2.
    Picture::new([3, 2], vec![9; 18]).write_png(&root.path().join("images/2.png")).unwrap();
    let opened = Dataset::open(root.path()).unwrap();
    let [first, twice, third] = [0, 1, 2].map(|i| opened.views[i].camera);
    assert_eq!(first.size_px, [8, 6]);
    assert_eq!(twice, dataset.views[1].camera.resized([16, 12]));
    assert_eq!((twice.focal_px, twice.center_px), (DVec2::new(16.0, 16.0), DVec2::new(8.0, 6.0)));
    assert_eq!(third.size_px, [3, 2]);
    Picture::new([6, 8], vec![9; 144]).write_png(&root.path().join("images/1.png")).unwrap();
    let text = complaint(root.path());
    assert!(text.contains("images/1.png") && text.contains("6 × 8") && text.contains("8 × 6"), "{text}");
}

#[test]
fn empty_pictures_are_named_and_a_single_one_is_left_out() {
    let root = tempfile::tempdir().unwrap();
    let whole = made_up(root.path());
    let last = &whole.views[whole.views.len() - 1];
    let fault = |name: &str| format!("images/{name}: is empty (0 bytes)");
    fs::write(root.path().join("images").join(&last.name), b"").unwrap();
    let Opened { dataset, damaged: told, .. } = Dataset::open_within(root.path(), usize::MAX).unwrap();
    assert_eq!((dataset.views.len(), dataset.find(&last.name)), (whole.views.len() - 1, None));
    let views = dataset.views.len() as u32;
    assert!(dataset.points.iter().all(|point| point.views.iter().all(|view| *view < views)));
    assert!(told.len() == 1 && told[0].contains(&fault(&last.name)), "{told:?}");
    whole.views.iter().for_each(|view| fs::write(&view.path, b"").unwrap());
    let text = complaint(root.path());
    assert!(text.contains(&fault(&whole.views[0].name)), "{text}");
}

#[test]
fn the_error_for_a_folder_without_dataset_names_the_layouts() {
    let root = tempfile::tempdir().unwrap();
    let text = complaint(root.path());
    assert!(text.contains("sparse/0/cameras.bin") && text.contains("transforms.json"), "{text}");
    colmap::write(root.path(), &Dataset::default()).unwrap();
    assert!(complaint(root.path()).contains("no pictures with poses"));
}

#[test]
fn names_cannot_lead_out_of_the_folder() {
    let root = tempfile::tempdir().unwrap();
    let mut dataset = made_up(root.path());
    dataset.views[0].name = "../images/0.png".into();
    colmap::write(root.path(), &dataset).unwrap();
    let opened = Dataset::open(root.path()).unwrap();
    assert_eq!(opened.find("images/0.png"), Some(2));
    for name in ["..", "", "a\u{7}b"] {
        dataset.views[0].name = name.into();
        colmap::write(root.path(), &dataset).unwrap();
        assert!(complaint(root.path()).contains("is not a valid picture name"), "{name:?}");
    }
    dataset.views[0].name = "./1.png".into();
    colmap::write(root.path(), &dataset).unwrap();
    assert!(complaint(root.path()).contains("two pictures are called 1.png"));
}

#[test]
fn every_eighth_view_is_held_out() {
    let root = tempfile::tempdir().unwrap();
    let mut dataset = made_up(root.path());
    dataset.views = (0..17).map(|_| dataset.views[0].clone()).collect();
    let (train, held_out) = dataset.split(8);
    assert_eq!(held_out, [0, 8, 16]);
    assert_eq!(train.len(), 14);
    assert_eq!(dataset.split(0), ((0..17).collect(), vec![]));
    assert_eq!(dataset.split(1).0, [0; 0]);
}

#[test]
fn a_subset_keeps_the_points_that_its_views_see() {
    let root = tempfile::tempdir().unwrap();
    let dataset = made_up(root.path());
    let subset = dataset.subset(&[2, 1, 2]);
    assert_eq!(subset.views, dataset.views[1..]);
    let kept: Vec<_> = subset.points.iter().map(|point| (point.position.x, point.views.clone())).collect();
    // The point at x = 4 has no track, but projects into the last view.
    assert_eq!(kept, [(1.0, vec![0]), (3.0, vec![0, 1]), (4.0, vec![])]);
    assert_eq!(dataset.subset(&[]), Dataset::default());
    assert_eq!(dataset.subset(&[0]).points.len(), 2);
}

#[test]
fn the_extent_follows_3dgs() {
    let root = tempfile::tempdir().unwrap();
    let dataset = made_up(root.path());
    assert!((dataset.extent() - 2.2).abs() < 1e-12);
    assert_eq!(Dataset::default().extent(), 0.0);
}

/// Opens those of the four scenes that are present; the others are skipped.
#[test]
fn real_scenes_are_opened() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    for (name, views, points, size_px) in [
        ("real_caliterra", 75, 36_210, [640, 481]),
        ("real_boruszyn", 27, 14_882, [478, 640]),
        ("gt_boruszyn", 136, 12_674, [480, 360]),
        ("gt_tiny", 24, 2_193, [160, 120]),
    ] {
        let root = folder.join(name);
        if !root.is_dir() {
            cosurf_tests::skips::skip("REQUIRE_DATASETS", format!("{name} is not in ../shared/data"));
            continue;
        }
        let dataset = Dataset::open(&root).unwrap();
        assert_eq!((dataset.views.len(), dataset.points.len()), (views, points), "{name}");
        assert!(dataset.views.iter().all(|view| view.camera.size_px == size_px), "{name}");
        let (mut seen, mut in_picture) = (0, 0);
        for point in &dataset.points {
            assert!(point.views.len() >= 2, "{name}: only {} views see a point", point.views.len());
            seen += point.views.len();
            let sees = |view: &&u32| dataset.views[**view as usize].camera.sees(point.position);
            in_picture += point.views.iter().filter(sees).count();
        }
        // Nearly every point projects into the pictures of its track, so coordinate frames and ids
        // are right. The rest are outliers.
        assert!(in_picture * 100 > seen * 95, "{name}: {in_picture} of {seen}");
        assert!(Picture::read(&dataset.views[0].path).unwrap().rgb.iter().any(|&value| value > 60));
    }
}

/// A folder of a model has cameras and no pictures: it can be rendered from, and not be trained on.
#[test]
fn the_cameras_of_a_model_are_read_without_pictures() {
    let (data, model) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let cameras: Vec<Camera> = made_up(data.path()).views.iter().map(|view| view.camera).collect();
    let list = model.path().join(camera_list::FILE);
    camera_list::write(&list, &cameras).unwrap();
    for path in [model.path(), &list] {
        assert_eq!(Dataset::cameras(path).unwrap(), cameras);
        let posed = Dataset::posed(path).unwrap();
        assert_eq!(posed.views[2].name, "camera-0003");
        assert_eq!(posed.views[2].camera, cameras[2]);
        assert!(complaint(path).contains("no pictures"), "{}", complaint(path));
    }
    fs::remove_file(data.path().join("images/1.png")).unwrap();
    assert_eq!(Dataset::posed(data.path()).unwrap().views[1].name, "1.png");
    assert!(complaint(data.path()).contains("missing"));
    let blind = Camera { size_px: [0, 6], ..cameras[1] };
    camera_list::write(&list, &[cameras[0], blind]).unwrap();
    assert!(Dataset::posed(model.path()).unwrap_err().to_string().contains("camera 1 has no pixels"));
    fs::write(&list, "[]").unwrap();
    assert!(Dataset::posed(model.path()).is_err());
}

#[test]
fn photographs_without_poses_are_told_what_comes_first() {
    for at in ["DSC_1.JPG", "images/b.png"] {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("images")).unwrap();
        let error = || Dataset::open(folder.path()).unwrap_err().to_string();
        assert!(error().contains("holds no dataset"), "{}", error());
        fs::write(folder.path().join(at), "pixels").unwrap();
        let command = format!("`cosurf-agent ingest {} --out DATA`", folder.path().display());
        assert!(error().contains(&command), "{}", error());
    }
}

#[test]
fn of_several_models_that_with_most_pictures_is_read_and_the_others_are_told() {
    let root = tempfile::tempdir().unwrap();
    let dataset = made_up(root.path());
    let sparse = root.path().join("sparse");
    assert_eq!(Dataset::notes(root.path()), [""; 0]);
    fs::rename(sparse.join("0"), sparse.join("1")).unwrap();
    let part = Dataset { views: dataset.views[..1].to_vec(), points: Vec::new() };
    colmap::write(root.path(), &part).unwrap();
    assert_eq!(Dataset::open(root.path()).unwrap().views.len(), 3);
    let notes = Dataset::notes(root.path());
    assert_eq!(notes.len(), 1);
    assert!(
        notes[0].contains("sparse/1: used, with 3 pictures") && notes[0].contains("sparse/0 (1)"),
        "{notes:?}"
    );
}

#[test]
fn smaller_pictures_are_taken_if_they_suffice() {
    let root = tempfile::tempdir().unwrap();
    made_up(root.path());
    let small = root.path().join("images_2");
    fs::create_dir(&small).unwrap();
    let open = || Dataset::open(root.path()).unwrap();
    for i in 0..2 {
        Picture::new([4, 3], vec![9; 36]).write_png(&small.join(format!("{i}.png"))).unwrap();
    }
    assert_eq!(open().take_smaller_pictures(4), None, "one is missing");
    Picture::new([4, 3], vec![9; 36]).write_png(&small.join("2.png")).unwrap();
    assert_eq!(open().take_smaller_pictures(5), None, "they are too small");
    let mut dataset = open();
    assert_eq!(dataset.take_smaller_pictures(4), Some(small.clone()));
    assert_eq!((dataset.views[1].camera.size_px, &dataset.views[1].path), ([4, 3], &small.join("1.png")));
    assert_eq!(dataset.views[1].camera.focal_px, DVec2::splat(4.0));
}

#[test]
fn pictures_with_an_extension_in_capitals_are_found() {
    let root = tempfile::tempdir().unwrap();
    made_up(root.path());
    let images = root.path().join("images");
    fs::rename(images.join("1.png"), images.join("1.PNG")).unwrap();
    assert_eq!(Dataset::open(root.path()).unwrap().views[1].path, images.join("1.PNG"));
}

#[test]
fn what_is_not_used_is_told_in_a_line_each() {
    let root = tempfile::tempdir().unwrap();
    let text = r#"{"w": 8, "h": 6, "fl_x": 8, "train_filenames": ["a.png"], "frames": [{"file_path": "a.png",
        "depth_file_path": "d.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}]}"#;
    fs::write(root.path().join("transforms.json"), text).unwrap();
    let notes = Dataset::notes(root.path());
    for (note, word) in notes.iter().zip(["depth_file_path", "train_filenames"]) {
        assert!(note.contains(word) && note.lines().count() == 1, "{note}");
    }
    assert_eq!(notes.len(), 2, "{notes:?}");
}

#[test]
fn masks_are_found_beside_the_images_and_in_transforms_json() {
    let root = tempfile::tempdir().unwrap();
    made_up(root.path());
    let masks = root.path().join("masks");
    fs::create_dir(&masks).unwrap();
    assert!(Dataset::open(root.path()).unwrap().views.iter().all(|view| view.mask.is_none()));
    for name in ["0.png", "1.png.png"] {
        Picture::new([8, 6], vec![0; 144]).write_png(&masks.join(name)).unwrap();
    }
    let dataset = Dataset::open(root.path()).unwrap();
    let found: Vec<_> = dataset.views.iter().map(|view| view.mask.as_ref().map(|mask| &mask.path)).collect();
    assert_eq!(found, [Some(&masks.join("0.png")), Some(&masks.join("1.png.png")), None]);
    let notes = Dataset::notes(root.path());
    assert!(notes[0].contains("2 of 3 pictures have masks"), "{notes:?}");
    assert!(
        notes[1].contains("hide 100 % of the sparse points") && notes[1].contains("masks_inverted"),
        "{notes:?}"
    );
    fs::rename(&masks, root.path().join("masks_inverted")).unwrap();
    let dataset = Dataset::open(root.path()).unwrap();
    assert!(dataset.views[0].mask.as_ref().is_some_and(|mask| mask.is_inverted));
    assert_eq!(Dataset::notes(root.path()).len(), 1);

    let text = r#"{"w": 8, "h": 6, "fl_x": 8, "frames": [{"file_path": "images/0.png", "mask_path": "m.png",
        "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}]}"#;
    fs::write(root.path().join("transforms.json"), text).unwrap();
    let file = root.path().join("transforms.json");
    let error = Dataset::open(&file).unwrap_err().to_string();
    assert!(error.contains("m.png: this mask is missing"), "{error}");
    fs::write(root.path().join("m.png"), "").unwrap();
    let mask = Dataset::open(&file).unwrap().views[0].mask.clone();
    assert_eq!(mask, Some(Mask { path: root.path().join("m.png"), is_inverted: false }));
}

#[test]
fn pictures_that_exif_turns_are_told() {
    let root = tempfile::tempdir().unwrap();
    made_up(root.path());
    // EXIF in the format of TIFF: little-endian, one entry, the tag 0x112 (orientation) with the short 6.
    let exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
    let path = root.path().join("images/0.png");
    fs::remove_file(&path).unwrap();
    Picture::new([8, 6], vec![9; 144]).write_photograph(&path, 90, exif.to_vec()).unwrap();
    let notes = Dataset::notes(root.path());
    assert!(notes.len() == 1 && notes[0].contains("EXIF orientation 6"), "{notes:?}");
    Picture::new([6, 8], vec![9; 144]).write_photograph(&path, 90, exif.to_vec()).unwrap();
    assert!(complaint(root.path()).contains("mogrify"));
}

#[test]
fn other_things_than_datasets_are_told_what_comes_next() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| {
        let path = root.path().join(name);
        fs::write(&path, "x").unwrap();
        path
    };
    for (name, word) in [
        ("flight.MP4", "ffmpeg"),
        ("data.zip", "unpack"),
        ("photo.jpg", "give the folder"),
        ("cameras.xml", "Metashape's XML"),
        ("poses.csv", "RealityCapture's CSV"),
    ] {
        let path = at(name);
        assert!(complaint(&path).contains(word), "{name}: {}", complaint(&path));
        fs::remove_file(path).unwrap();
    }
    at("flight.mp4");
    assert!(complaint(root.path()).contains("flight.mp4 is a video"));
    fs::create_dir(root.path().join("opensfm")).unwrap();
    assert!(complaint(root.path()).contains("opensfm undistort"));
}
