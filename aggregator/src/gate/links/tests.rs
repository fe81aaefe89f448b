//! Models of the same ground of coloured stones. In each test, one of the models lies in another frame or shows
//! nonsense.
#![allow(clippy::unwrap_used)]

use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Pose, Splats};
use glam::{DQuat, DVec2, DVec3};

use super::*;
use crate::gate::adjust::tests::Dice;
use crate::gate::extent::extents;
use crate::gate::frames::{Placement, find_frames};
use crate::gate::similarity::tests::wrong;
use crate::gate::tests::{MOVED, UNMOVED, workspace};
use crate::gate::{Doubt, Frames, admit};
use crate::merge::shifts::Shifts;
use crate::merge::{InMemory, Locals, MergeError, ModelSize};
use cosurf_link::Model;

/// A pseudo-random number in 0..1 for each lattice point; another `salt` gives other numbers.
fn noise(x: i32, y: i32, salt: u32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x9e37_79b9) ^ (y as u32).wrapping_mul(0x85eb_ca6b) ^ salt;
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    ((h ^ (h >> 15)) >> 8) as f32 / (1 << 24) as f32
}

/// Stones of about a metre on hilly ground between `west` and `east`, each of its own colour. Another `salt` gives
/// other splats for the same stones.
fn stones(west: f32, east: f32, salt: u32) -> Splats {
    const STEP: f32 = 0.2;
    let mut splats = Splats::with_capacity(0, 0);
    for i in (west / STEP) as i32..(east / STEP) as i32 {
        for j in -40..40 {
            let (x, y) = (STEP * (i as f32 + noise(i, j, salt)), STEP * (j as f32 + noise(i, j, salt ^ 1)));
            let stone = |salt| noise((x * 0.9 + 100.0) as i32, (y * 1.1 + 100.0) as i32, salt);
            let sh = [7, 8, 9].map(|salt| (0.1 + 0.8 * stone(salt) - 0.5) / SH_C0);
            let z = 0.5 * (0.7 * x).sin() * (0.6 * y).cos();
            splats.push([x, y, z], [1.0, 0.0, 0.0, 0.0], [-1.9, -1.9, -5.0], 4.0, &sh);
        }
    }
    splats
}

fn camera(x: f64, y: f64) -> Camera {
    let eye = DVec3::new(x, y, 9.0);
    Camera {
        cam_from_world: Pose::look_at(eye, DVec3::new(x, y, 0.0), DVec3::Y),
        focal_px: DVec2::splat(110.0),
        center_px: DVec2::new(80.0, 60.0),
        size_px: [160, 120],
    }
}

/// A model of the ground around `x = place`. `salt` chooses the splats.
pub(crate) fn local(place: f32, salt: u32) -> Model {
    let x = f64::from(place);
    let places = [-3.0, -1.0, 1.0, 3.0].into_iter().flat_map(|dx| [-1.5, 1.5].map(|y| camera(x + dx, y)));
    Model { splats: stones(place - 8.0, place + 8.0, salt), cameras: places.collect() }
}

fn mirrored(model: &Model) -> Model {
    let mut mirrored = model.clone();
    mirrored.splats.means.iter_mut().for_each(|mean| mean[1] = -mean[1]);
    mirrored
}

/// The model with shuffled colours and with splats lifted to random heights.
fn nonsense(model: &Model) -> Model {
    let mut nonsense = model.clone();
    let colors = model.splats.sh.clone();
    let count = model.splats.len();
    for i in 0..count {
        let from = (noise(i as i32, 3, 5) * count as f32) as usize % count;
        nonsense.splats.sh[3 * i..3 * i + 3].copy_from_slice(&colors[3 * from..3 * from + 3]);
        nonsense.splats.means[i][2] += 3.0 * noise(i as i32, 4, 6);
    }
    nonsense
}

fn find(one: &Model, other: &Model) -> Option<Similarity> {
    let locals = InMemory(vec![one.clone(), other.clone()]);
    let models = Scouted::of(&locals, Shifts::PAIR, &std::env::temp_dir(), &|| false).unwrap();
    let [mut one, mut other] = [0, 1].map(|i| models.hold(i, 1).unwrap());
    Some(links(&mut one, &mut other, &Similarity::IDENTITY)?.0)
}

/// Where models in unknown frames are moved.
fn placed(models: Vec<Model>) -> Placement {
    let locals = InMemory(models);
    let extents = extents(&locals, &|| false).unwrap();
    find_frames(&locals, &extents, false, workspace(&std::env::temp_dir()), &|| false).unwrap()
}

#[test]
fn a_model_in_another_frame_is_moved_back_to_a_thousandth_of_the_extent() {
    let [one, right] = [local(-3.0, 10), local(3.0, 10)];
    let there = wrong().model(&right);
    let back = find(&one, &there).unwrap().model(&there);
    let eye = |camera: &Camera| camera.cam_from_world.center();
    let off =
        back.cameras.iter().zip(&right.cameras).map(|(a, b)| eye(a).distance(eye(b))).fold(0.0, f64::max);
    let eyes: Vec<DVec3> = one.cameras.iter().chain(&right.cameras).map(eye).collect();
    let mean = eyes.iter().sum::<DVec3>() / eyes.len() as f64;
    let extent = eyes.iter().map(|eye| 1.1 * eye.distance(mean)).fold(0.0, f64::max);
    assert!(off < 1e-3 * extent, "off by {off:.4} m of {extent:.1} m");
}

#[test]
fn a_mirrored_or_shuffled_model_fits_nowhere() {
    for bad in [mirrored(&local(3.0, 20)), nonsense(&local(3.0, 20))] {
        let one = local(-3.0, 10);
        assert_eq!(find(&one, &bad), None);
        let frames = placed(vec![one, bad]);
        assert_eq!((frames.moves, frames.fits), (vec![None, None], Vec::new()), "in any frame");
    }
}

#[test]
fn a_model_in_a_frame_of_its_own_is_found() {
    let [one, right] = [local(-3.0, 10), local(3.0, 20)];
    let mut dice = Dice(11);
    for scale in [0.1, 10.0] {
        let rotation = DQuat::from_axis_angle(dice.vector().normalize(), 3.1);
        let there = Similarity { scale, rotation, translation: 100.0 * dice.vector() };
        let given = vec![one.clone(), there.model(&right)];
        let moves = placed(given.clone()).moves;
        assert_eq!(moves[0], None);
        let back = moves[1].unwrap().by.model(&given[1]);
        let eye = |camera: &Camera| camera.cam_from_world.center();
        let cameras = back.cameras.iter().zip(&right.cameras);
        let off = cameras.map(|(a, b)| eye(a).distance(eye(b))).fold(0.0, f64::max);
        assert!(off < 0.05, "scale {scale}: off by {off:.4} m");
    }
}

#[test]
fn a_model_in_another_frame_is_moved_if_allowed_and_kept_out_otherwise() {
    let models = [local(-3.0, 10), wrong().model(&local(0.0, 20)), local(3.0, 30)].to_vec();
    let locals = InMemory(models);
    let kept_out = admit(&locals, UNMOVED, workspace(&std::env::temp_dir()), &|| false).unwrap();
    assert_eq!(kept_out.doubts()[1], Some(Doubt::Contradicts(vec![0, 2])));
    assert_eq!(kept_out.count(), 2);
    let moved = admit(&locals, MOVED, workspace(&std::env::temp_dir()), &|| false).unwrap();
    assert_eq!((moved.doubts(), moved.count()), (&[None, None, None][..], 3));
    assert!(moved.place(1).by.is_some() && moved.place(0).by.is_none());
    let x = moved.load(1).unwrap().cameras[0].cam_from_world.center().x;
    assert!((x - -3.0).abs() < 0.05, "its first camera is at {x:.3} m");
}

/// Models of a site of which some tell that their place on the earth is not known.
struct SomePlaced {
    models: InMemory,
    is_placed: [bool; 2],
}

impl Locals for SomePlaced {
    fn count(&self) -> usize {
        self.models.count()
    }

    fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
        self.models.size(index)
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        self.models.load(index)
    }

    fn is_placed(&self, index: usize) -> bool {
        self.is_placed[index]
    }
}

#[test]
fn a_model_without_a_place_is_found_in_a_site_whose_frames_are_vouched_for() {
    let there = Similarity {
        scale: 0.1,
        rotation: DQuat::from_rotation_z(2.0),
        translation: DVec3::new(60.0, -80.0, 20.0),
    };
    let frames = Frames { refine: true, vouched: true };
    let by = |is_placed| {
        let models = InMemory(vec![local(-3.0, 10), there.model(&local(3.0, 20))]);
        let locals = SomePlaced { models, is_placed };
        let scratch = std::env::temp_dir();
        let admitted = admit(&locals, frames, workspace(&scratch), &|| false).unwrap();
        (0..admitted.count()).find(|i| admitted.place(*i).local == 1).and_then(|i| {
            let x = admitted.load(i).unwrap().cameras[0].cam_from_world.center().x;
            admitted.place(i).by.map(|_| x)
        })
    };
    let x = by([true, false]).expect("a model without a place is moved");
    assert!(x.abs() < 0.05, "its first camera is at {x:.3} m");
    assert_eq!(by([true, true]), None, "a model whose frame is known stays there");
}
