use cosurf_scene::{Camera, Pose, Splats};
use glam::{DQuat, DVec2, DVec3};

use super::{Example, SurfaceSettings, TrainSettings, Trainer, TrainingViews};
use crate::align::tests::{above, ground};
use crate::backend::{Backend, Channels, TargetRgb};
use crate::budget::Capacity;
use crate::cpu::CpuBackend;
use crate::cpu::tests::{camera, splats};
use crate::neighbours::Neighbours;
use crate::poses::{PoseChoice, PosesFound};
use crate::render::Renderer;
use crate::schedule::Schedule;

const STEPS: u32 = 40;

/// Trains a model. Returns it as it is when the surface losses end, and as it is at the end of training.
fn train(surface: Option<SurfaceSettings>) -> [Splats; 2] {
    let truth = splats(60, 0.4, -1.6, 0.0, 0, 7);
    let mut start = truth.clone();
    start.sh.iter_mut().for_each(|v| *v = 0.0);
    let eyes = [[3.0, 2.0, 1.5], [-3.0, 2.0, 1.5]];
    let cameras: Vec<Camera> =
        eyes.iter().map(|eye| camera(DVec3::from(*eye), 40.0, DVec2::new(22.0, 14.5))).collect();
    let mut shown = Renderer::new(&truth, 1);
    let photographs: Vec<Vec<f32>> = cameras.iter().map(|camera| shown.render(camera).rgb).collect();
    let mut backend = CpuBackend::new(Capacity::to_train(&start, &cameras, Channels::Geometry), 1);
    backend.load(&start);
    let settings = TrainSettings {
        schedule: Schedule::new(STEPS),
        extent: 4.0,
        sh_degree: 0,
        surface,
        prune: None,
        exposure: false,
        poses: PoseChoice::Fixed,
        observers_min: 2,
        splats_max: 0,
        seed: 5,
    };
    let mut trainer =
        Trainer::new(backend, settings, TrainingViews { cameras, neighbours: Neighbours::none() });
    let mut run_to = |end: u32| {
        while trainer.steps_done() < end {
            let view = trainer.view_index(0);
            let rgb = TargetRgb::Floats(&photographs[view]);
            trainer.step(&Example { view, rgb, neighbour: None });
        }
        trainer.backend().splats()
    };
    [settings.schedule.surface_until, STEPS].map(&mut run_to)
}

/// Cameras above the ground, and those that a training is told: turned by up to `turn`, rad, each about another axis.
fn flight(turn: f64) -> [Vec<Camera>; 2] {
    let truth: Vec<Camera> =
        (0..9).map(|i| above(0.8 * f64::from(i % 3 - 1), 0.8 * f64::from(i / 3 - 1))).collect();
    let axes = [DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y].into_iter().cycle();
    let wrong = |(camera, axis): (&Camera, DVec3)| {
        let turned = DQuat::from_scaled_axis(turn * axis);
        let Pose { rotation, translation } = camera.cam_from_world;
        Camera {
            cam_from_world: Pose { rotation: turned * rotation, translation: turned * translation },
            ..*camera
        }
    };
    let given = truth.iter().zip(axes).map(wrong).collect();
    [truth, given]
}

/// Trains poses that are off by `turn`. Stops after `stop` steps, and goes on in another trainer. Returns the splats and cameras
/// at the end, and what was found out about the poses.
fn train_poses(choice: PoseChoice, turn: f64, stop: u32) -> (Splats, Vec<Camera>, Option<PosesFound>) {
    const STEPS: u32 = 600;
    let [truth, given] = flight(turn);
    let ground = ground();
    let mut shown = Renderer::new(&ground, 1);
    let photographs: Vec<Vec<f32>> = truth.iter().map(|camera| shown.render(camera).rgb).collect();
    let mut start = Splats::with_capacity(ground.len() / 2, 0);
    (0..ground.len() / 2).for_each(|i| start.push_from(&ground, 2 * i));
    start.sh.iter_mut().for_each(|value| *value = 0.0);
    let settings = TrainSettings {
        schedule: Schedule::new(STEPS),
        extent: 2.0,
        sh_degree: 0,
        surface: Some(SurfaceSettings::default()),
        prune: None,
        exposure: false,
        poses: choice,
        observers_min: 1,
        splats_max: 0,
        seed: 5,
    };
    let begin = || {
        let mut backend = CpuBackend::new(Capacity::to_train(&start, &given, Channels::Geometry), 1);
        backend.load(&start);
        let views = TrainingViews { cameras: given.clone(), neighbours: Neighbours::none() };
        Trainer::new(backend, settings, views)
    };
    let run_to = |trainer: &mut Trainer<CpuBackend>, end: u32| {
        while trainer.steps_done() < end {
            let view = trainer.view_index(0);
            trainer.step(&Example { view, rgb: TargetRgb::Floats(&photographs[view]), neighbour: None });
        }
    };
    let mut first = begin();
    run_to(&mut first, stop);
    let mut numbers = Vec::new();
    let visited: Result<(), ()> = first.export(|part| {
        numbers.extend_from_slice(part);
        Ok(())
    });
    let (mut second, mut rest) = (begin(), numbers.as_slice());
    let filled: Result<(), ()> = second.import(first.progress(), |part| {
        let (mine, others) = rest.split_at(part.len());
        part.copy_from_slice(mine);
        rest = others;
        Ok(())
    });
    assert_eq!((visited, filled, rest.len()), (Ok(()), Ok(()), 0));
    run_to(&mut second, STEPS);
    (second.backend().splats(), second.cameras().to_vec(), second.poses_found())
}

/// How far the pictures of other cameras lie beside those of the true ones: mean over the views, px.
fn mean_beside_px(truth: &[Camera], others: &[Camera]) -> f64 {
    let beside = |(truth, other): (&Camera, &Camera)| {
        let corners = [[16.0, 16.0], [112.0, 16.0], [16.0, 80.0], [112.0, 80.0]].map(DVec2::from);
        let off = |corner: DVec2| other.project(truth.unproject(corner, 4.0)).map(|at| at.distance(corner));
        corners.into_iter().filter_map(off).sum::<f64>() / corners.len() as f64
    };
    truth.iter().zip(others).map(beside).sum::<f64>() / truth.len() as f64
}

#[test]
fn poses_that_are_not_exact_are_learnt() {
    let [truth, given] = flight(0.02);
    let (_, learnt, found) = train_poses(PoseChoice::Auto, 0.02, 0);
    let [before, after] = [given, learnt].map(|cameras| mean_beside_px(&truth, &cameras));
    assert!(before > 2.0 && after < 0.35 * before, "{before} px beside the truth, then {after} px");
    assert!(found.is_some_and(|found| found.learnt && found.median_px > 1.0), "{found:?}");
}

#[test]
fn exact_poses_have_the_bits_of_fixed_ones() {
    let (fixed, auto) = (train_poses(PoseChoice::Fixed, 0.0, 0), train_poses(PoseChoice::Auto, 0.0, 0));
    assert_eq!((&auto.0, &auto.1), (&fixed.0, &fixed.1));
    assert!(auto.2.is_some_and(|found| !found.learnt) && fixed.2.is_none(), "{:?}", auto.2);
}

#[test]
fn a_training_that_learns_poses_goes_on_with_the_same_bits() {
    let whole = train_poses(PoseChoice::Auto, 0.02, 0);
    // Before the first look, while poses are measured, when it is known that they are wrong, and after.
    let [from, known, ..] = Schedule::new(600).pose_steps(9);
    for stop in [from, known - 2, known, known + 1, 300, 599] {
        assert_eq!(train_poses(PoseChoice::Auto, 0.02, stop), whole, "stopped after {stop} steps");
    }
}

#[test]
fn shapes_are_frozen_after_the_surface_losses_end() {
    let [before, after] = train(Some(SurfaceSettings::default()));
    assert_eq!(before.quats, after.quats);
    assert_eq!(before.log_scales, after.log_scales);
    assert_ne!(before.means, after.means);
    assert_ne!(before.sh, after.sh);
}

#[test]
fn shapes_keep_training_without_surface_losses() {
    let [before, after] = train(None);
    assert_ne!(before.quats, after.quats);
    assert_ne!(before.log_scales, after.log_scales);
}

#[test]
fn surface_losses_begin_and_end_on_schedule() {
    let schedule = Schedule::new(1000);
    let ramp = [0, 232, 233, 234, 849, 850, 999].map(|step| schedule.surface_ramp(step));
    assert_eq!(ramp, [None, None, Some(0.0), Some(0.001), Some(0.616), None, None]);
}
