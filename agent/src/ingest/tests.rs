//! Whole runs with a program in place of COLMAP, which copies a reconstruction that the test has made.

#![allow(clippy::unwrap_used)]

use std::os::unix::fs::PermissionsExt;

use cosurf_geo::SiteFrame;
use cosurf_scene::{Camera, Picture, Pose, Shrinking, SparsePoint, View, colmap, mask};
use glam::{DQuat, DVec2, DVec3};
use tempfile::TempDir;

use super::*;

/// Metres for each unit of the reconstruction.
const SCALE: f64 = 10.0;
const ORIGIN: Geodetic = Geodetic { latitude_deg: 53.0, longitude_deg: 16.0, height_m: 60.0 };

/// Stands in for COLMAP, with a lens that needs no undistortion: notes its commands in `calls`, fails at the command that `fails` names with the reason in `luck`.
const SCRIPT: &str = r#"#!/bin/sh
here=$(dirname "$0")
case "$1 $2" in
"help "*) echo "COLMAP 3.8 -- Structure-from-Motion"; echo "  image_undistorter"; exit 0;;
*" --help") echo "  --database_path arg  --image_path arg --image_list_path arg --match_list_path arg --input_path arg --output_path arg --ImageReader.mask_path arg --random_seed arg"; exit 0;;
esac
command=$1; shift
echo "$command" >> "$here/calls"
if [ "$command" = "$(cat "$here/fails")" ]; then echo "ERROR: $(cat "$here/luck")"; echo "Elapsed time: 0"; exit 1; fi
while [ $# -gt 0 ]; do
  case "$1" in
  --output_path) out=$2;;
  --input_path) in=$2;;
  --random_seed) seed=$2;;
  --image_path) images=$2;;
  --ImageReader.mask_path) cp -r "$2" "$here/seen-masks";;
  esac
  shift
done
case "$command" in
feature_extractor) echo "Processed file [4/4]";;
mapper) [ "$(cat "$here/fails")" = nothing ] && exit 0; mkdir "$out/0"; cp "$here/undistorted/sparse/"* "$out/0"; echo "$seed" > "$out/0/seed";;
model_converter) cp "$here/text/"* "$out"; cp "$here/text-$(cat "$in/seed")/"* "$out" 2> "$here/none" || true;;
image_undistorter) cp -r "$here/undistorted/." "$out"; cp "$in/images.bin" "$in/points3D.bin" "$out/sparse"
  case "$images" in *masks-as-pictures) cp -r "$images/." "$out/images";; esac;;
esac
"#;

/// A flight of four photographs in a square of 100 m, 50 m above the ground, which look down, and its reconstruction: x
/// is north, y is down, z is west.
struct Flight {
    folder: TempDir,
}

impl Flight {
    fn new() -> Self {
        let flight = Self { folder: tempfile::tempdir().unwrap() };
        for folder in ["photos", "text", "undistorted/images", "undistorted/sparse"] {
            fs::create_dir_all(flight.at(folder)).unwrap();
        }
        fs::write(flight.at("fails"), "").unwrap();
        fs::write(flight.at("luck"), "no luck").unwrap();
        fs::write(flight.at("colmap"), SCRIPT).unwrap();
        fs::set_permissions(flight.at("colmap"), fs::Permissions::from_mode(0o755)).unwrap();
        let picture =
            |seed: u8| Picture::new([64, 48], (0..64 * 48 * 3).map(|i| (i % 199) as u8 ^ seed).collect());
        let site = SiteFrame::new(ORIGIN).unwrap();
        let (mut views, mut images, mut geo) = (Vec::new(), String::new(), "EPSG:4326\n".to_owned());
        for (i, enu) in Self::places().into_iter().enumerate() {
            let name = format!("a{i}.JPG");
            picture(i as u8).write_jpeg(&flight.at("photos").join(&name), 90).unwrap();
            picture(i as u8).write_jpeg(&flight.at("undistorted/images").join(&name), 90).unwrap();
            let camera = Self::camera(enu, i);
            let Pose { rotation: q, translation: t } = camera.cam_from_world;
            images += &format!("{i} {} {} {} {} {} {} {} 1 {name}\n", q.w, q.x, q.y, q.z, t.x, t.y, t.z);
            let seen = camera.project(model_from_enu(DVec3::ZERO)).unwrap();
            images += &format!("{} {} 7\n", seen.x, seen.y);
            views.push(View {
                name: name.clone(),
                camera,
                path: flight.at("undistorted/images").join(&name),
                mask: None,
            });
            let place = site.geodetic_from_enu(enu);
            geo += &format!("{name} {} {} {}\n", place.longitude_deg, place.latitude_deg, place.height_m);
        }
        fs::write(flight.at("text/images.txt"), images).unwrap();
        let DVec3 { x, y, z } = model_from_enu(DVec3::ZERO);
        fs::write(flight.at("text/points3D.txt"), format!("7 {x} {y} {z} 9 9 9 0 0 0 1 0\n")).unwrap();
        fs::write(flight.at("text/cameras.txt"), "1 OPENCV 64 48 50 50 32 24 0 0 0 0\n").unwrap();
        fs::write(flight.at("photos/geo.txt"), geo).unwrap();
        let point = SparsePoint { position: model_from_enu(DVec3::ZERO), rgb: [9; 3], views: vec![0, 1] };
        let made = flight.folder.path().join("made");
        fs::create_dir_all(&made).unwrap();
        colmap::write(&made, &Dataset { views, points: vec![point] }).unwrap();
        for file in ["cameras.bin", "images.bin", "points3D.bin"] {
            fs::copy(made.join("sparse/0").join(file), flight.at("undistorted/sparse").join(file)).unwrap();
        }
        flight
    }

    /// East, north, up, metres.
    fn places() -> [DVec3; 4] {
        [[-50.0, -50.0], [-50.0, 50.0], [50.0, 50.0], [50.0, -50.0]].map(|[x, y]| DVec3::new(x, y, 50.0))
    }

    /// A camera in the frame of the reconstruction, which looks down with another heading each.
    fn camera(enu: DVec3, turn: usize) -> Camera {
        let eye = model_from_enu(enu);
        let down = model_from_enu(DVec3::NEG_Z);
        let heading = DQuat::from_axis_angle(down.normalize(), turn as f64 * std::f64::consts::FRAC_PI_2);
        let cam_from_world = Pose::look_at(eye, eye + down, heading * model_from_enu(DVec3::Y));
        Camera {
            cam_from_world,
            focal_px: DVec2::splat(50.0),
            center_px: DVec2::new(32.0, 24.0),
            size_px: [64, 48],
        }
    }

    /// Moves the places from `geo.txt` to the XMP of the photographs, with this flag of RTK.
    fn write_xmp(&self, flag: u32) {
        fs::remove_file(self.at("photos/geo.txt")).unwrap();
        let site = SiteFrame::new(ORIGIN).unwrap();
        for (i, enu) in Self::places().into_iter().enumerate() {
            let Geodetic { latitude_deg, longitude_deg, height_m } = site.geodetic_from_enu(enu);
            let packet = format!(
                r#"<d:x xmlns:d="http://www.dji.com/drone-dji/1.0/" d:GpsLatitude="{latitude_deg:+}" d:RtkFlag="{flag}"
                d:GpsLongitude="{longitude_deg:+}" d:AbsoluteAltitude="{height_m:+}" d:RtkStdLon="0.01" d:RtkStdLat="0.01"/>"#
            );
            let content = [b"http://ns.adobe.com/xap/1.0/\0", packet.as_bytes()].concat();
            let length = u16::try_from(content.len() + 2).unwrap().to_be_bytes();
            let path = self.at(&format!("photos/a{i}.JPG"));
            let jpeg = fs::read(&path).unwrap();
            let segments: [&[u8]; 5] = [&jpeg[..2], &[0xFF, 0xE1], &length, &content, &jpeg[2..]];
            fs::write(&path, segments.concat()).unwrap();
        }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn plan(&self) -> IngestPlan {
        IngestPlan {
            photographs: self.at("photos"),
            out: self.at("data"),
            colmap: self.at("colmap"),
            origin: Some(ORIGIN),
            geoid: None,
            max_size_px: 1920,
        }
    }

    /// Runs, and returns the commands of COLMAP that it needed.
    fn run(&self, plan: &IngestPlan) -> (Result<Ingested, IngestError>, Vec<String>, Vec<AgentEvent>) {
        let _ = fs::remove_file(self.at("calls"));
        let mut events = Vec::new();
        let ingested = ingest(plan, &mut |event| events.push(event));
        let calls = fs::read_to_string(self.at("calls")).unwrap_or_default();
        let calls = calls.lines().filter(|call| *call != "model_converter").map(str::to_owned).collect();
        (ingested, calls, events)
    }
}

fn model_from_enu(enu: DVec3) -> DVec3 {
    DVec3::new(enu.y, -enu.z, -enu.x) / SCALE
}

const ALL: [&str; 4] = ["feature_extractor", "matches_importer", "mapper", "image_undistorter"];

#[test]
fn a_flight_lies_where_its_places_say() {
    let flight = Flight::new();
    let (ingested, calls, _) = flight.run(&flight.plan());
    let ingested = ingested.unwrap();
    assert_eq!(calls, ALL);
    let report = IngestReport { photographs: 4, posed: 4, points: 1, georeferenced: true };
    assert_eq!(ingested.report, report);
    let dataset = Dataset::open(&flight.at("data")).unwrap();
    for (view, place) in dataset.views.iter().zip(Flight::places()) {
        let center = view.camera.cam_from_world.center();
        assert!(center.distance(place) < 0.05, "{}: {center}", view.name);
        assert!(view.camera.cam_from_world.forward().distance(DVec3::NEG_Z) < 0.001);
    }
    assert!(dataset.points[0].position.length() < 0.05);
    let geo = Georeference::of_folder(&flight.at("data")).unwrap().unwrap();
    assert!(!is_without_place(&flight.at("data")));
    assert_eq!(geo.origin, ORIGIN);
    assert_eq!(geo.residuals.gps.unwrap().agreeing, 4);
}

#[test]
fn places_and_accuracies_of_xmp_count_where_exif_has_none() {
    let known_m = |flag| {
        let flight = Flight::new();
        flight.write_xmp(flag);
        let (ingested, calls, _) = flight.run(&flight.plan());
        assert_eq!(calls, ALL, "COLMAP reads no XMP: the pairs are listed for it");
        let residuals = ingested.unwrap().georeference.unwrap().residuals;
        let gps = residuals.gps.unwrap();
        assert_eq!((gps.with_accuracy, gps.agreeing), (4, 4));
        let center = Dataset::open(&flight.at("data")).unwrap().views[0].camera.cam_from_world.center();
        assert!(center.distance(Flight::places()[0]) < 0.05, "{center}");
        residuals.uncertainty.unwrap().horizontal_m
    };
    let (fixed_m, single_m) = (known_m(50), known_m(16));
    assert!(fixed_m < 0.05 && single_m > 0.5, "{fixed_m} {single_m}");
}

/// What an ingest told of what it leaves out, as `name: reason`.
fn left_out(events: &[AgentEvent]) -> Vec<String> {
    let told = |event: &AgentEvent| match event {
        AgentEvent::LeftOut { name, reason } => Some(format!("{name}: {reason}")),
        _ => None,
    };
    events.iter().filter_map(told).collect()
}

/// Gives the draws of this seed a lens of their own, or photographs whose names are exchanged.
fn misunderstand(flight: &Flight, seed: u32, lens: Option<&str>) {
    let wrong = flight.at(&format!("text-{seed}"));
    fs::create_dir(&wrong).unwrap();
    if let Some(lens) = lens {
        return fs::write(wrong.join("cameras.txt"), lens).unwrap();
    }
    let images = fs::read_to_string(flight.at("text/images.txt")).unwrap();
    // Its places are those of the flight, but in another order.
    let images = images.replace("a1", "a4").replace("a2", "a1").replace("a4", "a2");
    fs::write(wrong.join("images.txt"), images).unwrap();
}

const TWICE: [&str; 5] = [ALL[0], ALL[1], ALL[2], ALL[2], ALL[3]];

#[test]
fn poses_that_places_or_the_lens_contradict_are_looked_for_again() {
    let lens = "1 OPENCV 64 48 93 74 32 24 -0.6 0 0 0\n";
    for (lens, reason) in [
        (None, "the first poses: places of GPS lie "),
        (Some(lens), "the first poses: the focal length is 93 pixels along x, but 74 along y; "),
    ] {
        let flight = Flight::new();
        misunderstand(&flight, 0, lens);
        let (ingested, calls, events) = flight.run(&flight.plan());
        assert_eq!(calls, TWICE);
        let told = left_out(&events);
        assert!(told[0].starts_with(reason) && told[0].ends_with("COLMAP looks for others"), "{told:?}");
        assert_eq!(told.len(), 1);
        assert_eq!(ingested.unwrap().georeference.unwrap().residuals.gps.unwrap().agreeing, 4);
        let center = Dataset::open(&flight.at("data")).unwrap().views[0].camera.cam_from_world.center();
        assert!(center.distance(Flight::places()[0]) < 0.05, "{center}");
    }
}

#[test]
fn places_that_contradict_all_poses_do_not_count() {
    let flight = Flight::new();
    (0..2).for_each(|seed| misunderstand(&flight, seed, None));
    let (ingested, calls, events) = flight.run(&flight.plan());
    assert_eq!(calls, TWICE);
    assert!(!ingested.unwrap().report.georeferenced && !flight.at("data/geo.json").exists());
    let told = left_out(&events).pop().unwrap();
    assert!(told.starts_with("the place on the earth: "), "{told}");
}

#[test]
fn stretched_pictures_keep_their_pixels_and_are_told() {
    let flight = Flight::new();
    (0..2).for_each(|seed| misunderstand(&flight, seed, Some("1 OPENCV 64 48 50 65 32 24 0 0 0 0\n")));
    let (ingested, calls, events) = flight.run(&flight.plan());
    assert_eq!(calls, TWICE);
    let told = left_out(&events);
    let told_of = |name: &str| told.iter().any(|told| told.starts_with(name));
    assert!(told.contains(&"the second poses: they are no better; the first ones stay".into()), "{told:?}");
    assert!(told_of("square pixels: the focal length is 50 pixels along x, but 65 along y"), "{told:?}");
    assert!(ingested.unwrap().report.georeferenced, "its places are right");
}

#[test]
fn a_look_without_poses_is_not_taken_for_one_that_is_done() {
    let flight = Flight::new();
    fs::write(flight.at("fails"), "nothing").unwrap();
    let error = flight.run(&flight.plan()).0.unwrap_err().to_string();
    assert!(error.starts_with("COLMAP found the places of 0 of 4 photographs"), "{error}");
    fs::write(flight.at("fails"), "").unwrap();
    let (done, calls, _) = flight.run(&flight.plan());
    done.unwrap();
    assert_eq!(calls, ALL[2..]);
}

#[test]
fn the_pictures_of_a_dataset_are_no_photographs_for_it() {
    let flight = Flight::new();
    flight.run(&flight.plan()).0.unwrap();
    let again = IngestPlan { photographs: flight.at("data/images"), ..flight.plan() };
    let error = flight.run(&again).0.unwrap_err().to_string();
    assert!(error.contains("itself; name another folder with --out"), "{error}");
}

#[test]
fn without_places_only_up_is_known() {
    let flight = Flight::new();
    fs::remove_file(flight.at("photos/geo.txt")).unwrap();
    let (ingested, calls, _) = flight.run(&flight.plan());
    assert!(!ingested.unwrap().report.georeferenced);
    assert!(is_without_place(&flight.at("data")) && !is_without_place(&flight.at("photographs")));
    assert_eq!(calls[1], "exhaustive_matcher");
    assert!(!flight.at("data/geo.json").exists());
    let dataset = Dataset::open(&flight.at("data")).unwrap();
    let forward = dataset.views[0].camera.cam_from_world.forward();
    assert!(forward.distance(DVec3::NEG_Z) < 0.001, "{forward}");
}

#[test]
fn finished_stages_are_not_done_again_unless_their_input_changes() {
    let flight = Flight::new();
    fs::write(flight.at("fails"), "mapper\n").unwrap();
    let (failed, calls, _) = flight.run(&flight.plan());
    let error = failed.unwrap_err().to_string();
    assert!(error.contains("mapper failed: ERROR: no luck; ") && error.contains("poses.log"), "{error}");
    assert_eq!(calls, ALL[..3]);
    fs::write(flight.at("fails"), "").unwrap();
    let (done, calls, events) = flight.run(&flight.plan());
    done.unwrap();
    assert_eq!(calls, ALL[2..]);
    let resumed = events.iter().filter(|event| matches!(event, AgentEvent::Ingesting { resumed: true, .. }));
    assert_eq!(resumed.count(), 2);
    assert_eq!(flight.run(&flight.plan()).1, [""; 0]);
    // Another photograph: what follows the end of a JPEG is not read, but makes it no copy.
    let another = [&fs::read(flight.at("photos/a0.JPG")).unwrap()[..], b"another"].concat();
    fs::write(flight.at("photos/b.JPG"), another).unwrap();
    let (done, calls, events) = flight.run(&flight.plan());
    done.unwrap();
    assert_eq!(calls, ALL);
    let is_told = |event: &AgentEvent| matches!(event, AgentEvent::LeftOut { name, .. } if name == "b.JPG");
    assert!(events.iter().any(is_told), "{events:?}");
}

#[test]
fn photographs_without_poses_are_told_in_our_words() {
    let flight = Flight::new();
    fs::write(flight.at("fails"), "mapper\n").unwrap();
    fs::write(flight.at("luck"), "failed to create sparse model").unwrap();
    let error = flight.run(&flight.plan()).0.unwrap_err().to_string();
    assert!(error.starts_with("COLMAP found the places of 0 of 4 photographs"), "{error}");
}

#[test]
fn a_killed_program_is_told_and_the_same_command_goes_on() {
    let flight = Flight::new();
    let script = SCRIPT.replace("exit 1; fi", "kill -9 $$; fi");
    fs::write(flight.at("colmap"), script).unwrap();
    fs::write(flight.at("fails"), "mapper\n").unwrap();
    let error = flight.run(&flight.plan()).0.unwrap_err().to_string();
    assert!(error.contains("mapper failed: it was killed") && !error.contains('\n'), "{error}");
    fs::write(flight.at("fails"), "").unwrap();
    let (done, calls, _) = flight.run(&flight.plan());
    done.unwrap();
    assert_eq!(calls, ALL[2..]);
}

#[test]
fn a_finished_dataset_without_its_work_is_made_again() {
    let flight = Flight::new();
    flight.run(&flight.plan()).0.unwrap();
    let told = fs::read_to_string(flight.at("data/ingest.json")).unwrap();
    assert!(told.contains("photos") && told.contains("\"posed\": 4"), "{told}");
    fs::remove_dir_all(flight.at("data/.ingest")).unwrap();
    // Nothing is lost if that fails.
    let missing = IngestPlan { colmap: flight.at("nowhere"), ..flight.plan() };
    flight.run(&missing).0.unwrap_err();
    assert_eq!(Dataset::open(&flight.at("data")).unwrap().views.len(), 4);
    fs::remove_dir_all(flight.at("data/.ingest")).unwrap();
    let (done, calls, _) = flight.run(&flight.plan());
    done.unwrap();
    assert_eq!(calls, ALL);
}

#[test]
fn folders_of_others_and_missing_programs_are_refused() {
    let flight = Flight::new();
    let missing = IngestPlan { colmap: flight.at("nowhere"), ..flight.plan() };
    let error = flight.run(&missing).0.unwrap_err().to_string();
    assert!(error.contains("nowhere") && error.contains("apt-get install colmap"), "{error}");
    // Another folder each: programs that other tests start just now may still hold the lock on the first.
    let other = IngestPlan { colmap: "/bin/echo".into(), out: flight.at("other"), ..flight.plan() };
    let error = flight.run(&other).0.unwrap_err().to_string();
    assert!(error.contains("is not COLMAP"), "{error}");
    fs::write(flight.at("colmap"), SCRIPT.replace("image_undistorter", "image_rectifier")).unwrap();
    let old = IngestPlan { out: flight.at("old"), ..flight.plan() };
    let error = flight.run(&old).0.unwrap_err().to_string();
    assert!(error.contains("is not COLMAP 3.6 or newer") && !error.contains('\n'), "{error}");
    // Of a version to come, which calls an option by another name.
    fs::write(flight.at("colmap"), SCRIPT.replace("--image_list_path arg", "--list arg")).unwrap();
    let new = IngestPlan { out: flight.at("new"), ..flight.plan() };
    let error = flight.run(&new).0.unwrap_err().to_string();
    assert!(
        error.contains("feature_extractor has no option --image_list_path") && !error.contains('\n'),
        "{error}"
    );
    let onto_photographs = IngestPlan { out: flight.at("photos"), ..flight.plan() };
    let error = flight.run(&onto_photographs).0.unwrap_err().to_string();
    assert!(error.contains("--out"), "{error}");
}

#[test]
fn masks_go_to_colmap_and_into_the_dataset() {
    let flight = Flight::new();
    fs::create_dir(flight.at("photos/masks")).unwrap();
    // Of half the size, its left side hides.
    let half = (0..24).flat_map(|_| (0..32).flat_map(|x| [if x < 16 { 0 } else { 255 }; 3]));
    Picture::new([32, 24], half.collect()).write_png(&flight.at("photos/masks/a1.JPG.png")).unwrap();
    let (done, calls, _) = flight.run(&flight.plan());
    done.unwrap();
    assert_eq!(calls[..4], ALL);
    assert_eq!(calls[4..], ["image_undistorter"]);
    let seen = Picture::read(&flight.at("seen-masks/a1.JPG.png")).unwrap();
    assert_eq!((seen.size_px, seen.rgb[0], seen.rgb[3 * 63]), ([64, 48], 0, 255));
    let dataset = Dataset::open(&flight.at("data")).unwrap();
    let hidden = |i: usize| {
        let View { path, mask, .. } = &dataset.views[i];
        let picture = mask::read(path, mask.as_ref(), [64, 48], Shrinking::AfterDecoding).unwrap();
        picture.counted().filter(|counts| !counts).count()
    };
    assert_eq!([hidden(0), hidden(1)], [0, 32 * 48]);
    fs::write(flight.at("photos/masks/a1.JPG.png"), "no picture").unwrap();
    let (_, _, events) = flight.run(&flight.plan());
    let is_told = |event: &AgentEvent| matches!(event, AgentEvent::LeftOut { name, reason } if name == "a1.JPG" && reason.starts_with("its mask"));
    assert!(events.iter().any(is_told), "{events:?}");
}
