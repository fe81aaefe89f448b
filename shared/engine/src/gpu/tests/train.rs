//! Whole trainings: similar on both backends, and equal in two runs on the GPU.

use cosurf_scene::{Camera, Splats};
use glam::DVec3;

use super::adapter::gpu;
use super::compare::{on_cpu, on_gpu};
use super::forward::centered;
use crate::backend::{Backend, TargetRgb};
use crate::cpu::tests::splats;
use crate::random::{Purpose, Random};
use crate::{
    Example, Neighbours, PoseChoice, PruneSettings, Renderer, Schedule, SurfaceSettings, TrainSettings,
    Trainer, TrainingViews,
};

/// Trains the model in `backend` on pictures of the model `truth`. Returns the trained model and its mean PSNR, dB.
fn train<B: Backend>(
    backend: B,
    steps: u32,
    surface: Option<SurfaceSettings>,
    prune: Option<PruneSettings>,
    truth: &Splats,
    cameras: &[Camera],
) -> (Splats, f64) {
    let settings = TrainSettings {
        schedule: Schedule::new(steps),
        extent: 4.0,
        sh_degree: 1,
        surface,
        prune,
        exposure: false,
        poses: PoseChoice::Fixed,
        observers_min: 2,
        splats_max: backend.capacity(),
        seed: 5,
    };
    let mut shown = Renderer::new(truth, 2);
    let photographs: Vec<Vec<f32>> = cameras.iter().map(|camera| shown.render(camera).rgb).collect();
    let views = TrainingViews { cameras: cameras.to_vec(), neighbours: Neighbours::none() };
    let mut trainer = Trainer::new(backend, settings, views);
    while !trainer.is_done() {
        let view = trainer.view_index(0);
        let rgb = TargetRgb::Floats(&photographs[view]);
        trainer.step(&Example { view, rgb, neighbour: None });
    }
    let trained = trainer.into_backend().splats();
    let mut shown = Renderer::new(&trained, 2);
    let psnr = |(camera, photograph): (&Camera, &Vec<f32>)| {
        cosurf_scene::metrics::psnr(&shown.render(camera).rgb, photograph)
    };
    let psnrs: Vec<f64> = cameras.iter().zip(&photographs).map(psnr).collect();
    (trained, psnrs.iter().sum::<f64>() / psnrs.len() as f64)
}

/// The true model, the perturbed model and the cameras of the trainings below.
fn lesson() -> (Splats, Splats, Vec<Camera>) {
    let eyes = [[3.0, 2.0, 1.5], [-3.0, 2.0, 1.5], [3.0, -2.0, 1.5], [-2.5, -2.5, 1.0]];
    let cameras: Vec<Camera> = eyes.iter().map(|eye| centered(DVec3::from(*eye), 60.0, [64, 48])).collect();
    let truth = splats(300, 0.6, -2.0, 1.0, 1, 21);
    let mut start = truth.clone();
    let mut random = Random::new(3, Purpose::Test, 1, 0);
    start.means.iter_mut().flatten().for_each(|v| *v += 0.05 * random.normal());
    start.sh.iter_mut().for_each(|v| *v = 0.0);
    (truth, start, cameras)
}

#[test]
fn trainings_are_similar_on_both_backends_and_reproducible() {
    let Some(gpu) = gpu() else { return };
    let (truth, start, cameras) = lesson();
    let size_px = cameras[0].size_px;
    let surface = Some(SurfaceSettings::default());
    let run = |steps| train(on_gpu(&gpu, &start, size_px), steps, surface, None, &truth, &cameras);
    let ((once, by_gpu), (_, first)) = (run(60), run(1));
    assert_eq!(once, run(60).0, "two runs give the same bits");
    let (_, by_cpu) = train(on_cpu(&start, size_px), 60, surface, None, &truth, &cameras);
    println!("60 steps: {by_cpu:.3} dB on the CPU, {by_gpu:.3} dB on the GPU, {first:.3} dB after the first");
    assert!((by_cpu - by_gpu).abs() < 0.1, "{by_cpu} dB on the CPU, {by_gpu} dB on the GPU");
    assert!(
        by_gpu > first + 1.0,
        "training improves the model: {first} dB after a step, {by_gpu} dB after 60"
    );
}

#[test]
fn trainings_with_pruning_are_similar_on_both_backends_and_reproducible() {
    let Some(gpu) = gpu() else { return };
    let (truth, start, cameras) = lesson();
    let size_px = cameras[0].size_px;
    let prune = Some(PruneSettings::default());
    let run = || train(on_gpu(&gpu, &start, size_px), 60, None, prune, &truth, &cameras);
    let (once, by_gpu) = run();
    assert_eq!(once, run().0, "two runs give the same bits");
    let (expected, by_cpu) = train(on_cpu(&start, size_px), 60, None, prune, &truth, &cameras);
    let (kept, of) = (once.len(), start.len());
    println!("{kept} of {of} splats: {by_cpu:.3} dB on the CPU, {by_gpu:.3} dB on the GPU");
    assert_eq!(kept, expected.len());
    assert!(10 * kept <= 6 * of, "two fifths were removed: {kept} of {of}");
    assert!((by_cpu - by_gpu).abs() < 0.1, "{by_cpu} dB on the CPU, {by_gpu} dB on the GPU");
}
