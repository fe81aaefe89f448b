use cosurf_scene::{Camera, Splats};
use glam::{DVec2, DVec3};

use super::{Example, SurfaceSettings, TrainSettings, Trainer, TrainingViews};
use crate::backend::{Backend, Channels, TargetRgb};
use crate::budget::Capacity;
use crate::cpu::CpuBackend;
use crate::cpu::tests::{camera, splats};
use crate::neighbours::Neighbours;
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
