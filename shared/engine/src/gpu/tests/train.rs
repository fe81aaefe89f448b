//! Training: the GPU's losses, gradients, statistics, scores and edits against the CPU's, and both to the end.

use cosurf_scene::{Camera, Splats};
use glam::DVec3;

use super::forward::{centered, splats};
use super::gpu;
use crate::backend::{
    Backend, Birth, Channels, Edit, Exposure, LossWeights, Losses, SurfaceWeights, TargetRgb, Targets,
};
use crate::gpu::{Gpu, GpuBackend};
use crate::random::{Purpose, Random};
use crate::{
    CpuBackend, CpuCapacity, Example, Flight, Neighbours, Renderer, Schedule, SurfaceSettings, TrainSettings,
    Trainer,
};

/// Largest error of a gradient, relative to itself or to a hundredth of its group's root mean square.
const TOLERANCE: f32 = 1e-3;
/// Share of the numbers that may be further off: those of splats that meet a threshold tie, see the pictures.
const TIES_MAX: f64 = 5e-3;

/// Room for a few splats more.
fn capacity(splats: &Splats, size_px: [u32; 2]) -> CpuCapacity {
    CpuCapacity {
        splats: splats.len() + 100,
        pairs: 60_000,
        size_px,
        sh_degree: splats.sh_degree,
        channels: Channels::Geometry,
        training: true,
    }
}

pub(super) fn on_gpu(gpu: &Gpu, splats: &Splats, size_px: [u32; 2]) -> GpuBackend {
    let mut backend = GpuBackend::new(gpu, capacity(splats, size_px).into()).expect("room");
    backend.load(splats);
    backend
}

pub(super) fn on_cpu(splats: &Splats, size_px: [u32; 2]) -> CpuBackend {
    let mut backend = CpuBackend::new(capacity(splats, size_px), 2);
    backend.load(splats);
    backend
}

fn cases() -> Vec<(&'static str, Splats, Camera)> {
    let eye = DVec3::new(3.0, 2.0, 1.5);
    vec![
        ("no splats", Splats::with_capacity(0, 1), centered(eye, 40.0, [20, 20])),
        ("one pixel", splats(60, 0.4, -1.5, 0.0, 1, 2), centered(eye, 10.0, [1, 1])),
        ("rotated", splats(14, 0.4, -1.6, 0.0, 3, 3), centered(eye, 40.0, [44, 29])),
        // Wide angle: slopes are clamped, splats are behind and beside the camera.
        ("clamped", splats(500, 2.2, -0.8, 0.0, 2, 5), centered(eye, 14.0, [44, 29])),
        // Lists of more pairs than a group carries at once, full pixels.
        ("opaque", splats(2000, 0.5, -2.2, 3.0, 0, 7), centered(eye, 120.0, [120, 90])),
        ("wide", splats(600, 0.6, -3.0, 0.0, 1, 9), centered(eye, 400.0, [8192, 48])),
        ("many", splats(5000, 0.8, -3.0, 0.0, 3, 8), centered(eye, 150.0, [230, 140])),
    ]
}

/// A photograph of noise, in bytes.
fn noise(size_px: [u32; 2]) -> Vec<u8> {
    let mut random = Random::new(11, Purpose::Birth, 0, 0);
    (0..3 * size_px[0] * size_px[1]).map(|_| random.below(256) as u8).collect()
}

fn weights(channels: Channels) -> LossWeights {
    let surface = SurfaceWeights { normal: 0.3, reprojection: 0.0, ncc: 0.0, cell_px: 4, draw: 1 };
    LossWeights {
        ssim: 0.2,
        scale: 0.5,
        surface: (channels == Channels::Geometry).then_some(surface),
        teacher: None,
    }
}

/// One step up to the gradients.
fn step(backend: &mut impl Backend, camera: &Camera, degree: u32, channels: Channels) -> (Losses, Splats) {
    let noise = noise(camera.size_px);
    let targets = Targets {
        exposure: Exposure { gain: 1.1, offset: -0.02 },
        ..Targets::colors(TargetRgb::Bytes(&noise))
    };
    backend.project(camera, degree);
    assert_eq!(backend.bin().dropped, 0);
    backend.rasterize(channels);
    let losses = backend.losses(&targets, &weights(channels));
    backend.rasterize_backward();
    backend.project_backward();
    (losses, backend.gradients())
}

/// The numbers of splats, by group.
fn groups(splats: &Splats) -> [Vec<f32>; 5] {
    [
        splats.means.concat(),
        splats.quats.concat(),
        splats.log_scales.concat(),
        splats.opacity_logits.clone(),
        splats.sh.clone(),
    ]
}

/// How many numbers of a group are off by more than the tolerance.
pub(super) fn off_of(got: &[f32], expected: &[f32]) -> usize {
    let squares: f64 = expected.iter().map(|v| f64::from(*v).powi(2)).sum();
    let floor = 0.01 * (squares / expected.len().max(1) as f64).sqrt() as f32 + 1e-20;
    let within =
        |(got, expected): (&f32, &f32)| (got - expected).abs() <= TOLERANCE * expected.abs().max(floor);
    got.iter().zip(expected).filter(|pair| !within(*pair)).count()
}

/// How many numbers there are, and how many are off.
pub(super) fn compare(got: &Splats, expected: &Splats) -> (usize, usize) {
    let groups = || groups(got).into_iter().zip(groups(expected));
    (
        groups().map(|(_, expected)| expected.len()).sum(),
        groups().map(|(got, expected)| off_of(&got, &expected)).sum(),
    )
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-4 * b.abs().max(0.01)
}

#[test]
fn gradients_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    for (name, splats, camera) in cases() {
        for channels in [Channels::Color, Channels::Geometry] {
            let (mut gpu, mut cpu) = (on_gpu(&gpu, &splats, camera.size_px), on_cpu(&splats, camera.size_px));
            let (loss, got) = step(&mut gpu, &camera, splats.sh_degree, channels);
            let (expected_loss, expected) = step(&mut cpu, &camera, splats.sh_degree, channels);
            let numbers = |losses: &Losses| {
                let color = losses.color;
                [
                    color.total,
                    color.l1,
                    color.ssim,
                    color.mse,
                    color.by_gain,
                    color.by_offset,
                    losses.surface.normal,
                ]
            };
            for (got, expected) in numbers(&loss).into_iter().zip(numbers(&expected_loss)) {
                assert!(close(got, expected), "{name}: {loss:?} is not {expected_loss:?}");
            }
            let (count, off) = compare(&got, &expected);
            println!("{name} {channels:?}: {off} of {count} gradients are off");
            assert!(off as f64 <= TIES_MAX * count as f64, "{name} {channels:?}: {off} of {count} are off");
            let (shapes, expected_shapes) = (gpu.take_shapes(), cpu.take_shapes());
            assert_eq!(shapes.views, expected_shapes.views, "{name}");
            let wrong = off_of(&shapes.screen_gradients, &expected_shapes.screen_gradients)
                + off_of(&shapes.absolute_gradients, &expected_shapes.absolute_gradients);
            assert!(wrong <= splats.len() / 50, "{name}: {wrong} statistics are off");
            if splats.is_empty() {
                continue;
            }
            // The comparison sees gradients of which one in ten (seen or not) is wrong by a percent.
            let mut bent = got.clone();
            bent.means.iter_mut().chain(&mut bent.log_scales).flatten().step_by(10).for_each(|v| *v *= 1.01);
            bent.quats.iter_mut().flatten().chain(&mut bent.sh).step_by(10).for_each(|v| *v *= 1.01);
            assert!(compare(&bent, &expected).1 as f64 > TIES_MAX * count as f64, "{name}: went unnoticed");
        }
    }
}

#[test]
fn the_way_through_a_tile_does_not_change_a_bit() {
    let Some(gpu) = gpu() else { return };
    let (name, splats, camera) = cases().remove(4);
    let both = [gpu.clone(), gpu.disguised()].map(|gpu| {
        let mut backend = on_gpu(&gpu, &splats, camera.size_px);
        let (_, gradients) = step(&mut backend, &camera, splats.sh_degree, Channels::Geometry);
        backend.clear_scores();
        backend.score();
        (gradients, backend.scores())
    });
    assert!(both[0].1.hits.iter().sum::<f32>() > 0.0, "{name}: something is hit");
    assert_eq!(both[0], both[1], "{name}");
}

#[test]
fn scores_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    for (name, splats, camera) in cases() {
        fn scored(backend: &mut impl Backend, camera: &Camera) -> crate::backend::Scores {
            backend.clear_scores();
            for _ in 0..2 {
                backend.project(camera, 0);
                backend.bin();
                backend.rasterize(Channels::Color);
                backend.score();
            }
            backend.scores()
        }
        let got = scored(&mut on_gpu(&gpu, &splats, camera.size_px), &camera);
        let expected = scored(&mut on_cpu(&splats, camera.size_px), &camera);
        let off = (0..splats.len()).filter(|&i| {
            let error = (got.squared_weights[i] - expected.squared_weights[i]).abs();
            error > TOLERANCE * expected.squared_weights[i].max(1e-3)
                || got.hits[i] != expected.hits[i]
                || got.observers[i] != expected.observers[i]
        });
        let off = off.count();
        println!("{name}: {off} of {} scores are off", splats.len());
        assert!(off as f64 <= TIES_MAX * splats.len() as f64, "{name}: {off} of {}", splats.len());
        assert!(splats.is_empty() || expected.hits.iter().sum::<f32>() > 0.0, "{name}: something is hit");
    }
}

#[test]
fn edits_and_checkpoints_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let splats = splats(40, 0.4, -1.6, 0.0, 2, 3);
    let birth = |parent: u32| Birth {
        parent,
        mean: [parent as f32, 1.0, 2.0],
        log_scale: [-1.0, -2.0, -3.0],
        opacity_logit: 0.5,
    };
    let edits = [
        Edit { births: vec![birth(3), birth(39), birth(7)], deaths: vec![7, 20] },
        Edit { births: vec![birth(0)], deaths: vec![0, 5, 6, 36, 38, 39] },
        Edit { births: Vec::new(), deaths: (0..40).collect() },
        Edit { births: (0..60).map(|i| birth(i % 40)).collect(), deaths: Vec::new() },
    ];
    for edit in edits {
        let (mut gpu, mut cpu) = (on_gpu(&gpu, &splats, [8, 8]), on_cpu(&splats, [8, 8]));
        gpu.edit(&edit);
        cpu.edit(&edit);
        gpu.cap_opacity(0.4);
        cpu.cap_opacity(0.4);
        assert_eq!(gpu.splats(), cpu.splats(), "{edit:?}");
    }
}

/// Everything that a checkpoint of a backend keeps.
fn kept(backend: &impl Backend) -> Vec<f32> {
    let mut kept = Vec::new();
    let exported: Result<(), ()> = backend.export(|numbers| {
        kept.extend_from_slice(numbers);
        Ok(())
    });
    assert_eq!(exported, Ok(()));
    kept
}

fn restore(backend: &mut impl Backend, len: usize, mut kept: &[f32]) {
    let imported: Result<(), ()> = backend.import(len, |numbers| {
        let (now, later) = kept.split_at(numbers.len());
        numbers.copy_from_slice(now);
        kept = later;
        Ok(())
    });
    assert_eq!((imported, kept.len()), (Ok(()), 0));
}

#[test]
fn checkpoints_go_from_device_to_device() {
    let Some(gpu) = gpu() else { return };
    let splats = splats(1043, 0.4, -1.6, 0.0, 2, 3);
    let camera = centered(DVec3::new(3.0, 2.0, 1.5), 40.0, [44, 29]);
    let mut cpu = on_cpu(&splats, camera.size_px);
    let rates = Schedule::new(100).rates(7, 4.0);
    for _ in 0..3 {
        step(&mut cpu, &camera, 2, Channels::Color);
        cpu.adam(&rates);
    }
    let by_cpu = kept(&cpu);
    let mut moved = GpuBackend::new(&gpu, capacity(&splats, camera.size_px).into()).expect("room");
    restore(&mut moved, splats.len(), &by_cpu);
    assert_eq!(kept(&moved), by_cpu, "from the CPU to the GPU");
    assert_eq!(moved.splats(), cpu.splats());
    let mut back = on_cpu(&splats, camera.size_px);
    restore(&mut back, splats.len(), &kept(&moved));
    step(&mut back, &camera, 2, Channels::Color);
    back.adam(&rates);
    step(&mut cpu, &camera, 2, Channels::Color);
    cpu.adam(&rates);
    assert_eq!(kept(&back), kept(&cpu), "and back: the training goes on to the same bits");
}

#[test]
fn a_lost_device_is_told_and_nothing_panics() {
    let Some(gpu) = gpu() else { return };
    let splats = splats(60, 0.4, -1.5, 0.0, 1, 2);
    let camera = centered(DVec3::new(3.0, 2.0, 1.5), 40.0, [44, 29]);
    let mut backend = on_gpu(&gpu, &splats, camera.size_px);
    step(&mut backend, &camera, 1, Channels::Geometry);
    assert_eq!(backend.lost(), None);
    gpu.device.destroy();
    backend.project(&camera, 1);
    backend.bin();
    backend.rasterize(Channels::Geometry);
    backend.keep_neighbour();
    backend.take_shapes();
    let reason = backend.lost().expect("the device is lost");
    assert!(reason.contains("was lost"), "{reason}");
}

/// Trains a disturbed model back towards the truth that its photographs show; returns it and its mean PSNR.
fn train<B: Backend>(
    backend: B,
    steps: u32,
    surface: Option<SurfaceSettings>,
    truth: &Splats,
    cameras: &[Camera],
) -> (Splats, f64) {
    let settings = TrainSettings {
        schedule: Schedule::new(steps),
        extent: 4.0,
        sh_degree: 1,
        surface,
        prune: None,
        exposure: false,
        observers_min: 2,
        splats_max: backend.capacity(),
        seed: 5,
    };
    let mut shown = Renderer::new(truth, 2);
    let photographs: Vec<Vec<f32>> = cameras.iter().map(|camera| shown.render(camera).rgb).collect();
    let flight = Flight { cameras: cameras.to_vec(), neighbours: Neighbours::none() };
    let mut trainer = Trainer::new(backend, settings, flight);
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

/// What the trainings below see, and where they begin.
fn lesson() -> (Splats, Splats, Vec<Camera>) {
    let eyes = [[3.0, 2.0, 1.5], [-3.0, 2.0, 1.5], [3.0, -2.0, 1.5], [-2.5, -2.5, 1.0]];
    let cameras: Vec<Camera> = eyes.iter().map(|eye| centered(DVec3::from(*eye), 60.0, [64, 48])).collect();
    let truth = splats(300, 0.6, -2.0, 1.0, 1, 21);
    let mut start = truth.clone();
    let mut random = Random::new(3, Purpose::Birth, 1, 0);
    start.means.iter_mut().flatten().for_each(|v| *v += 0.05 * random.normal());
    start.sh.iter_mut().for_each(|v| *v = 0.0);
    (truth, start, cameras)
}

#[test]
#[ignore = "half a minute on a software driver"]
fn five_hundred_steps_end_alike() {
    let Some(gpu) = gpu() else { return };
    let (truth, start, cameras) = lesson();
    let size_px = cameras[0].size_px;
    let (_, by_cpu) = train(on_cpu(&start, size_px), 500, None, &truth, &cameras);
    let (_, by_gpu) = train(on_gpu(&gpu, &start, size_px), 500, None, &truth, &cameras);
    println!("500 steps: {by_cpu:.3} dB on the CPU, {by_gpu:.3} dB on the GPU");
    assert!((by_cpu - by_gpu).abs() < 0.1, "{by_cpu} dB on the CPU, {by_gpu} dB on the GPU");
}

#[test]
fn trainings_are_alike_and_twice_the_same() {
    let Some(gpu) = gpu() else { return };
    let (truth, start, cameras) = lesson();
    let size_px = cameras[0].size_px;
    let surface = Some(SurfaceSettings::default());
    let run = |steps| train(on_gpu(&gpu, &start, size_px), steps, surface, &truth, &cameras);
    let ((once, by_gpu), (_, first)) = (run(60), run(1));
    assert_eq!(once, run(60).0, "two runs give the same bits");
    let (_, by_cpu) = train(on_cpu(&start, size_px), 60, surface, &truth, &cameras);
    println!("60 steps: {by_cpu:.3} dB on the CPU, {by_gpu:.3} dB on the GPU, {first:.3} dB after the first");
    assert!((by_cpu - by_gpu).abs() < 0.1, "{by_cpu} dB on the CPU, {by_gpu} dB on the GPU");
    assert!(by_gpu > first + 1.0, "training goes on: {first} dB after a step, {by_gpu} dB after 60");
}
