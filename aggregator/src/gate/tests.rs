//! Models from flights over the same painted ground. In most tests, one of the models is wrong.
#![allow(clippy::unwrap_used)]

use std::env::temp_dir;
use std::f64::consts::FRAC_PI_2;
use std::fs;
use std::path::{Path, PathBuf};

use cosurf_scene::splats::SH_C0;
use cosurf_scene::{LocalFrame, Pose, Splats};
use cosurf_tests::dice::Dice;
use glam::{DQuat, DVec3};

pub(crate) use super::links::tests::local;
use super::*;
use crate::merge::InMemory;
use crate::merge::cameras::{middle, radius};
use crate::merge::shifts::Shifts;
use crate::testing::{above, ground};

/// A workspace with two threads.
pub(crate) fn workspace(scratch: &Path) -> Workspace<'_> {
    Workspace { scratch, threads: 2, memory_bytes: 4 << 30 }
}

/// Models are left where they are; those that share no ground are kept out.
pub(crate) const UNMOVED: Frames = Frames { refine: false, vouched: false };
/// Models are moved to where they fit; those that share no ground are kept out.
pub(crate) const MOVED: Frames = Frames { refine: true, vouched: false };

/// A model of the ground below a flight of five cameras, 2 m apart along the x axis, from x = `west`.
pub(crate) fn flight(west: f64) -> Model {
    let cameras = (0..5).map(|i| above(west + 2.0 * f64::from(i)));
    Model { splats: ground(west as f32 - 6.0, west as f32 + 14.0), cameras: cameras.collect() }
}

/// Four flights; each overlaps its neighbours.
pub(crate) fn flights() -> Vec<Model> {
    [0.0, 4.0, 8.0, 12.0].map(flight).to_vec()
}

/// The same model in another frame: scaled, then rotated about the vertical, then moved.
pub(crate) fn elsewhere(mut model: Model, scale: f64, turn: f64, by: DVec3) -> Model {
    let turn = DQuat::from_rotation_z(turn);
    let Model { splats, cameras } = &mut model;
    for mean in &mut splats.means {
        let moved = turn * (DVec3::from_array(mean.map(f64::from)) * scale) + by;
        *mean = moved.as_vec3().to_array();
    }
    for quat in &mut splats.quats {
        let [w, x, y, z] = quat.map(f64::from);
        let q = turn * DQuat::from_xyzw(x, y, z, w);
        *quat = [q.w, q.x, q.y, q.z].map(|v| v as f32);
    }
    splats.log_scales.iter_mut().flatten().for_each(|v| *v += scale.ln() as f32);
    for camera in cameras {
        let pose = &mut camera.cam_from_world;
        pose.rotation *= turn.inverse();
        pose.translation = pose.translation * scale - pose.rotation * by;
    }
    model
}

fn judge(models: Vec<Model>) -> Vec<Option<Doubt>> {
    let choosers = chosen::fixed(models.len());
    let Judgement { judged, .. } =
        super::judge(&InMemory(models), &choosers, &[], Shifts::PAIR, &temp_dir(), &|| false).unwrap();
    judged.into_iter().map(|judged| judged.doubt).collect()
}

#[test]
fn models_that_agree_are_admitted() {
    assert_eq!(judge(flights()), [None, None, None, None]);
    assert_eq!(judge(vec![flight(0.0)]), [None], "alone");
    let far = judge(vec![flight(0.0), flight(60.0)]);
    assert_eq!(far, [None, None], "they share no ground and are not too far apart");
}

#[test]
fn a_model_that_shares_no_ground_takes_part_only_if_its_frame_is_vouched_for() {
    let locals = InMemory(vec![flight(60.0), flight(0.0), flight(4.0)]);
    let names = ["far", "west", "east"];
    for refine in [false, true] {
        let admit =
            |vouched| admit(&locals, Frames { refine, vouched }, workspace(&temp_dir()), &|| false).unwrap();
        let unvouched = admit(false);
        let kept_out: Vec<(usize, String)> = unvouched.kept_out(&names).collect();
        assert!(kept_out.len() == 1 && kept_out[0].0 == 0, "{kept_out:?}");
        assert!(kept_out[0].1.contains("shares no ground"), "{kept_out:?}");
        let vouched = admit(true);
        let verified: Vec<bool> = (0..vouched.count()).map(|i| vouched.place(i).is_verified).collect();
        assert_eq!(verified, [false, true, true]);
    }
}

#[test]
fn a_model_that_its_own_cameras_do_not_show_is_kept_out() {
    let mut models = flights();
    // The cameras see the splats, but from so far away that their pictures are almost empty.
    for camera in &mut models[2].cameras {
        camera.cam_from_world.translation.z += 300.0;
    }
    let doubts = judge(models);
    assert!(matches!(doubts[2], Some(Doubt::Void(1.0))), "{doubts:?}");
    assert_eq!(doubts.iter().flatten().count(), 1, "{doubts:?}");
}

/// Flights over speckled ground. Model 1 shows other speckles on top, `error` times as strong. The pictures are larger
/// than those that the gate renders.
fn speckled_flights(error: f32) -> Vec<Model> {
    let mut models = flights();
    for (i, model) in models.iter_mut().enumerate() {
        model.cameras.iter_mut().for_each(|camera| *camera = camera.resized([384, 256]));
        speckle(model, 7919, 1.0);
        if i == 1 {
            speckle(model, 104_729, error);
        }
    }
    models
}

/// Changes the brightness of each splat by a random number, which depends on the place of the splat and on `salt`.
fn speckle(model: &mut Model, salt: i64, amount: f32) {
    let Splats { means, sh, .. } = &mut model.splats;
    for ([x, y, _], sh) in means.iter().zip(sh.chunks_exact_mut(3)) {
        let place = (2.0 * x).round() as i64 * 31 + (2.0 * y).round() as i64;
        let number = Dice((place * salt) as u64).unit() as f32 - 0.5;
        sh.iter_mut().for_each(|value| *value += amount * number);
    }
}

#[test]
fn a_model_far_worse_than_the_others_is_kept_out() {
    let locals = InMemory(speckled_flights(2.0));
    let admitted = admit(&locals, UNMOVED, workspace(&temp_dir()), &|| false).unwrap();
    let doubts = admitted.doubts();
    assert!(matches!(doubts[1], Some(Doubt::FarWorse(times)) if times > 4.0), "{doubts:?}");
    assert_eq!(doubts.iter().flatten().count(), 1, "{doubts:?}");
    let kept_out: Vec<(usize, String)> = admitted.kept_out(&["a", "b", "c", "d"]).collect();
    assert!(kept_out[0].1.starts_with("shows shared ground far worse than the others"), "{kept_out:?}");
}

#[test]
fn a_worse_model_counts_less() {
    let locals = InMemory(speckled_flights(1.2));
    let admitted = admit(&locals, UNMOVED, workspace(&temp_dir()), &|| false).unwrap();
    assert_eq!(admitted.count(), 4, "{:?}", admitted.doubts());
    let weights: Vec<f64> = (0..4).map(|i| admitted.place(i).trust.weight).collect();
    assert!(weights[1] < 0.5 && [0, 2, 3].iter().all(|i| weights[*i] == 1.0), "{weights:?}");
}

#[test]
fn a_model_that_is_brighter_at_one_end_than_at_the_other_counts_less() {
    let mut models = flights();
    let Splats { means, sh, .. } = &mut models[1].splats;
    for (rgb, mean) in sh.chunks_exact_mut(3).zip(means) {
        rgb.iter_mut().for_each(|value| *value += 0.02 * (mean[0] - 8.0) / SH_C0);
    }
    let locals = InMemory(models);
    let admitted = admit(&locals, UNMOVED, workspace(&temp_dir()), &|| false).unwrap();
    let weights: Vec<f64> = (0..4).map(|i| admitted.place(i).trust.weight).collect();
    assert!(weights[1] < 0.1 && [0, 2, 3].iter().all(|i| weights[*i] > 0.9), "{weights:?}");
}

/// A model names the right frame, but its coordinates are in another one.
#[test]
fn fault_09_wrong_frame_scale_datum_or_origin() {
    let wrongs: [(&str, f64, f64, DVec3); 6] = [
        ("the datum is 1 m higher", 1.0, 0.0, DVec3::Z),
        ("the origin is half a metre off", 1.0, 0.0, DVec3::new(-0.3, 0.4, 0.0)),
        ("the origin is that of another site", 1.0, 0.0, DVec3::new(40_000.0, 0.0, 0.0)),
        ("a fifth too large", 1.2, 0.0, DVec3::ZERO),
        ("in feet", 3.281, 0.0, DVec3::ZERO),
        ("north is taken for east", 1.0, FRAC_PI_2, DVec3::ZERO),
    ];
    for (what, scale, turn, by) in wrongs {
        for wrong in 0..4 {
            let mut models = flights();
            // The model is scaled and rotated about the ground below its flight. Otherwise it would overlap no other
            // flight.
            let middle = DVec3::X * (4.0 * wrong as f64 + 4.0);
            let about = middle - DQuat::from_rotation_z(turn) * (scale * middle);
            models[wrong] = elsewhere(models[wrong].clone(), scale, turn, by + about);
            let doubts = judge(models);
            assert!(doubts[wrong].is_some(), "{wrong}: {what}: {doubts:?}");
            assert_eq!(doubts.iter().flatten().count(), 1, "{wrong}: {what}: {doubts:?}");
        }
    }
}

/// The verdict does not depend on the order of the two models.
#[test]
fn of_two_contradicting_models_one_stays() {
    let (right, mut wrong) = (flight(0.0), elsewhere(flight(4.0), 1.0, 0.0, DVec3::Z));
    wrong.cameras.pop();
    assert!(matches!(judge(vec![right.clone(), wrong.clone()])[..], [None, Some(_)]));
    assert!(matches!(judge(vec![wrong, right])[..], [Some(_), None]));
}

#[test]
fn fault_07_poisoned_models() {
    let clean = flights();
    // Forged models: repainted ground, a wall in front of the cameras, splats where no camera of the model looks, and
    // glaring colours.
    let mut repainted = clean[1].clone();
    for (i, value) in repainted.splats.sh.iter_mut().enumerate() {
        *value = ((i * 7919 % 1000) as f32 / 500.0 - 1.0) * 1.5;
    }
    let mut walled = clean[1].clone();
    for x in -2..18 {
        let (mean, quat) = ([x as f32, 0.0, 5.0], [1.0, 0.0, 0.0, 0.0]);
        walled.splats.push(mean, quat, [0.5, 1.5, -5.0], 6.0, &[1.5, -1.0, 0.2]);
    }
    let mut spread = clean[1].clone();
    for i in 0..2000 {
        let mean = [-60.0 + 0.01 * i as f32, 30.0, 1.0];
        spread.splats.push(mean, [1.0, 0.0, 0.0, 0.0], [-1.0; 3], 6.0, &[1.0; 3]);
    }
    let mut glaring = clean[1].clone();
    glaring.splats.sh.iter_mut().for_each(|value| *value += 200.0);
    let all = [("repainted", repainted), ("walled", walled), ("spread", spread), ("glaring", glaring)];
    for (what, poisoned) in all {
        let mut models = clean.clone();
        models[1] = poisoned;
        let doubts = judge(models);
        assert!(doubts[1].is_some(), "{what}: {doubts:?}");
        assert_eq!(doubts.iter().flatten().count(), 1, "{what}: {doubts:?}");
    }
}

/// Reads the missions whose folders the environment variable `MISSIONS` lists, separated by colons. Returns the folder
/// of each mission and the models of its four agents.
pub(crate) fn trained() -> Vec<(String, Vec<Model>)> {
    let load = |folder: PathBuf| {
        let cameras = fs::read(folder.join("cameras.json")).unwrap();
        let splats = cosurf_scene::ply::read(&folder.join("model.ply"), &LocalFrame::WORLD).unwrap();
        Model { splats, cameras: serde_json::from_slice(&cameras).unwrap() }
    };
    let missions = std::env::var("MISSIONS").unwrap();
    let models = |mission: &str| {
        let agents = (1..=4).map(|agent| load(Path::new(mission).join(format!("agents/agent-{agent}"))));
        (mission.to_owned(), agents.collect())
    };
    missions.split(':').map(models).collect()
}

/// Judges the models of real missions, unchanged and with one of them moved. To run: `MISSIONS=DIR:DIR cargo test
/// --release -p cosurf-aggregator --lib -- --ignored trained_models --nocapture`
#[test]
#[ignore = "needs trained models"]
fn trained_models_are_judged_rightly() {
    for (mission, models) in trained() {
        let begun = std::time::Instant::now();
        let doubts = judge(models.clone());
        println!("{mission}: {doubts:?} in {:.1?}", begun.elapsed());
        assert!(doubts.iter().all(Option::is_none));
        for wrong in 0..models.len() {
            let cameras = &models[wrong].cameras;
            let radius = radius(cameras, middle(cameras));
            for (what, scale, by) in [
                ("moved", 1.0, 0.05 * DVec3::X),
                ("raised", 1.0, 0.05 * DVec3::Z),
                ("scaled", 1.1, DVec3::ZERO),
            ] {
                let mut models = models.clone();
                models[wrong] = elsewhere(models[wrong].clone(), scale, 0.0, radius * by);
                println!("{mission}: {wrong} {what}: {:?}", judge(models));
            }
        }
    }
}

#[test]
fn a_model_that_claims_larger_pictures_takes_part_with_the_pictures_that_it_shows() {
    let mut models = flights();
    let given = models[1].cameras[0].size_px;
    for camera in &mut models[1].cameras {
        *camera = camera.resized(camera.size_px.map(|side| 8 * side));
    }
    let locals = InMemory(models);
    let admitted = admit(&locals, UNMOVED, workspace(&temp_dir()), &|| false).unwrap();
    let sizes: Vec<f64> = (0..4).map(|i| admitted.place(i).size).collect();
    assert!((8.0 * sizes[1]).ln().abs() < 0.2, "{sizes:?}");
    assert!([0, 2, 3].iter().all(|i| sizes[*i] == 1.0), "{sizes:?}");
    let taken = admitted.load(1).unwrap().cameras[0];
    let sides = [taken.size_px, given].map(|size_px| f64::from(size_px[0]));
    assert!((sides[0] / sides[1]).ln().abs() < 0.2, "{taken:?}");
}

#[test]
fn a_model_without_splats_or_without_cameras_is_told_as_such() {
    let mut models = flights();
    models.push(Model { splats: Splats::with_capacity(0, 0), cameras: models[0].cameras.clone() });
    models.push(Model { splats: models[0].splats.without(&[0]), cameras: Vec::new() });
    let locals = InMemory(models);
    for frames in [UNMOVED, MOVED] {
        let admitted = admit(&locals, frames, workspace(&temp_dir()), &|| false).unwrap();
        assert_eq!(admitted.doubts()[4..], [Some(Doubt::Empty), Some(Doubt::Blind)], "{frames:?}");
        assert_eq!(admitted.count(), 4);
    }
}

/// A model cannot make a merge slow with more cameras than its splats can teach, and cameras that see nothing are told.
#[test]
fn cameras_beyond_what_a_model_can_teach_take_no_part_and_blind_ones_are_told() {
    let mut models = flights();
    let its = models[1].cameras.clone();
    models[1].cameras = its.iter().cycle().take(5000).copied().collect();
    let away = |camera: &mut Camera| {
        let turn = DQuat::from_rotation_x(std::f64::consts::PI);
        let pose = &mut camera.cam_from_world;
        *pose = Pose { rotation: turn * pose.rotation, translation: turn * pose.translation };
    };
    models[2].cameras.iter_mut().step_by(4).for_each(away);
    let splats = models[1].splats.len();
    let locals = InMemory(models);
    let admitted = admit(&locals, UNMOVED, workspace(&temp_dir()), &|| false).unwrap();
    let place = |local: usize| (0..admitted.count()).find(|i| admitted.place(*i).local == local).unwrap();
    let cameras = admitted.load(place(1)).unwrap().cameras.len();
    assert_eq!(cameras, CAMERAS_MIN.max(splats / SPLATS_PER_CAMERA));
    assert!((0.1..0.5).contains(&admitted.place(place(2)).void), "{:?}", admitted.place(place(2)));
    assert_eq!(admitted.place(place(0)).void, 0.0);
}

#[test]
fn a_model_with_one_splat_of_an_impossible_color_is_kept_out() {
    let mut models = flights();
    models[2].splats.sh[0] = -100.0;
    let doubts = judge(models);
    assert_eq!(doubts, [None, None, Some(Doubt::Glaring(100.0)), None]);
}
