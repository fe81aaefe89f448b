//! Measures each pass of a training step on a fixed workload: 640 × 480 px, and 50,000 splats with a standard deviation
//! of 0.8 to 4 px and an opacity of 0.05 to 0.9. Throughput is in splats, in splat–tile pairs or in pixels, depending
//! on the pass. Then whole steps of 480 × 270 px and 20,000 splats are measured, on the processor and on the best
//! graphics card, which may be a software driver.
//!
//! `cargo bench -p cosurf-engine`

use cosurf_engine::backend::{
    AdamRates, Channels, LossWeights, MultiviewWeights, PatchSide, SurfaceWeights, TargetRgb, Targets,
};
use cosurf_engine::budget::PAIRS_PER_SPLAT;
use cosurf_engine::{AnyBackend, Backend, Capacity, CpuBackend, DeviceChoice};
use cosurf_scene::{Camera, Pose, Splats};
use divan::Bencher;
use divan::counter::ItemsCount;
use glam::{DQuat, DVec2, DVec3};

const SIZE_PX: [u32; 2] = [640, 480];
const SPLATS: usize = 50_000;
const STEP_SIZE_PX: [u32; 2] = [480, 270];
const STEP_SPLATS: usize = 20_000;

fn main() {
    divan::main();
}

/// Random numbers in 0..1 (SplitMix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f32 / (1 << 24) as f32
    }

    fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.next()
    }
}

fn camera() -> Camera {
    camera_of(SIZE_PX)
}

fn camera_of(size_px: [u32; 2]) -> Camera {
    Camera {
        cam_from_world: Pose { rotation: DQuat::IDENTITY, translation: DVec3::ZERO },
        focal_px: DVec2::splat(500.0),
        center_px: DVec2::from(size_px.map(f64::from)) / 2.0,
        size_px,
    }
}

/// Random splats that fill the picture, at depths of 2 to 10 world units.
fn splats(count: usize, size_px: [u32; 2]) -> Splats {
    let mut random = Random(1);
    let mut splats = Splats::with_capacity(count, 3);
    let [width, height] = size_px.map(|side| side as f32);
    for _ in 0..count {
        let z = random.between(2.0, 10.0);
        let x = (random.between(0.0, width) - width / 2.0) * z / 500.0;
        let y = (random.between(0.0, height) - height / 2.0) * z / 500.0;
        let mut log_scale = || (random.between(0.8, 4.0) * z / 500.0).ln();
        let log_scales = [log_scale(), log_scale(), log_scale()];
        let quat = [0, 1, 2, 3].map(|_| random.between(-1.0, 1.0));
        let opacity = random.between(0.05, 0.9);
        let mut sh = [0.0; 48];
        sh.iter_mut().for_each(|value| *value = random.between(-0.3, 0.3));
        splats.push([x, y, z], quat, log_scales, (opacity / (1.0 - opacity)).ln(), &sh);
    }
    splats
}

fn backend(threads: usize) -> CpuBackend {
    let capacity = Capacity {
        splats: SPLATS,
        pairs: 400_000,
        size_px: SIZE_PX,
        sh_degree: 3,
        channels: Channels::Geometry,
        training: true,
    };
    let mut backend = CpuBackend::new(capacity, threads);
    backend.load(&splats(SPLATS, SIZE_PX));
    backend
}

/// A backend after all passes of a step except the optimiser, and the number of its splat–tile pairs.
fn stepped(threads: usize, channels: Channels) -> (CpuBackend, usize) {
    let mut backend = backend(threads);
    backend.project(&camera(), 3);
    backend.bin();
    let pairs = backend.counts().pairs;
    backend.rasterize(channels);
    losses(&mut backend);
    backend.rasterize_backward();
    backend.project_backward();
    (backend, pairs)
}

/// One training step. With surface losses, the view is its own neighbouring view.
fn step(backend: &mut impl Backend, rgb: TargetRgb, channels: Channels) {
    let camera = camera_of(STEP_SIZE_PX);
    let is_surface = channels == Channels::Geometry;
    if is_surface {
        backend.project(&camera, 0);
        backend.bin();
        backend.rasterize(channels);
        backend.keep_neighbour();
    }
    backend.project(&camera, 3);
    backend.bin();
    backend.rasterize(channels);
    let targets = Targets { neighbour_rgb: is_surface.then_some(rgb), ..Targets::colors(rgb) };
    backend.losses(&targets, if is_surface { &SURFACE } else { &COLOR });
    backend.rasterize_backward();
    backend.project_backward();
    backend.adam(&RATES);
}

fn losses(backend: &mut CpuBackend) {
    let rgb = vec![90u8; (3 * SIZE_PX[0] * SIZE_PX[1]) as usize];
    backend.losses(&Targets::colors(TargetRgb::Bytes(&rgb)), &COLOR);
}

const COLOR: LossWeights = LossWeights { ssim: 0.2, scale: 0.0, surface: None, teacher: None };

const SURFACE: LossWeights = LossWeights {
    surface: Some(SurfaceWeights {
        normal: 0.01,
        multiview: Some(MultiviewWeights {
            reprojection: 0.05,
            ncc: 0.2,
            cell_px: 2,
            patch: PatchSide::Px3,
            draw: 1,
        }),
    }),
    ..COLOR
};

const RATES: AdamRates = AdamRates {
    mean: 1e-9,
    quat: 1e-9,
    log_scale: 1e-9,
    opacity: 1e-9,
    sh_dc: 1e-9,
    sh_rest: 1e-9,
    first_correction: 1.0,
    second_correction: 1.0,
};

const CHANNELS: [Channels; 2] = [Channels::Geometry, Channels::Color];

#[divan::bench]
fn project(bencher: Bencher) {
    let (mut backend, _) = stepped(2, Channels::Geometry);
    bencher.counter(ItemsCount::new(SPLATS)).bench_local(|| backend.project(&camera(), 3));
}

#[divan::bench]
fn bin(bencher: Bencher) {
    let (mut backend, pairs) = stepped(2, Channels::Geometry);
    bencher.counter(ItemsCount::new(pairs)).bench_local(|| backend.bin());
}

#[divan::bench(args = CHANNELS)]
fn rasterize(bencher: Bencher, channels: Channels) {
    let (mut backend, pairs) = stepped(2, channels);
    bencher.counter(ItemsCount::new(pairs)).bench_local(|| backend.rasterize(channels));
}

#[divan::bench(args = CHANNELS)]
fn rasterize_forward_and_backward(bencher: Bencher, channels: Channels) {
    let (mut backend, pairs) = stepped(2, channels);
    bencher.counter(ItemsCount::new(pairs)).bench_local(|| {
        backend.rasterize(channels);
        backend.rasterize_backward();
    });
}

#[divan::bench]
fn photometric_loss(bencher: Bencher) {
    let (mut backend, _) = stepped(2, Channels::Color);
    let pixels = (SIZE_PX[0] * SIZE_PX[1]) as usize;
    bencher.counter(ItemsCount::new(pixels)).bench_local(|| losses(&mut backend));
}

/// Measures the surface losses and the colour loss together. The view is its own neighbouring view, so all patches
/// match.
#[divan::bench]
fn surface_losses(bencher: Bencher) {
    let (mut backend, _) = stepped(2, Channels::Geometry);
    backend.keep_neighbour();
    let pixels = (SIZE_PX[0] * SIZE_PX[1]) as usize;
    let mut random = Random(2);
    let rgb: Vec<u8> = (0..3 * pixels).map(|_| random.between(0.0, 255.0) as u8).collect();
    let targets =
        Targets { neighbour_rgb: Some(TargetRgb::Bytes(&rgb)), ..Targets::colors(TargetRgb::Bytes(&rgb)) };
    bencher.counter(ItemsCount::new(pixels)).bench_local(|| backend.losses(&targets, &SURFACE));
}

#[divan::bench]
fn project_backward(bencher: Bencher) {
    let (mut backend, _) = stepped(2, Channels::Geometry);
    bencher.counter(ItemsCount::new(SPLATS)).bench_local(|| backend.project_backward());
}

#[divan::bench]
fn adam(bencher: Bencher) {
    let (mut backend, _) = stepped(2, Channels::Geometry);
    bencher.counter(ItemsCount::new(SPLATS)).bench_local(|| backend.adam(&RATES));
}

#[divan::bench(args = CHANNELS)]
fn step_on_cpu(bencher: Bencher, channels: Channels) {
    steps(bencher, DeviceChoice::Cpu, channels);
}

#[divan::bench(args = CHANNELS, sample_count = 10)]
fn step_on_gpu(bencher: Bencher, channels: Channels) {
    steps(bencher, DeviceChoice::Gpu(None), channels);
}

fn steps(bencher: Bencher, choice: DeviceChoice, channels: Channels) {
    let capacity = Capacity {
        splats: STEP_SPLATS,
        pairs: PAIRS_PER_SPLAT * STEP_SPLATS,
        size_px: STEP_SIZE_PX,
        sh_degree: 3,
        channels,
        training: true,
    };
    let Ok(device) = choice.open() else {
        eprintln!("{choice}: no such device");
        return;
    };
    let mut backend = AnyBackend::new(&device, capacity, 2).expect("room for it");
    eprintln!("{}", backend.device());
    backend.load(&splats(STEP_SPLATS, STEP_SIZE_PX));
    let mut random = Random(2);
    let pixels = STEP_SIZE_PX[0] * STEP_SIZE_PX[1];
    let rgb: Vec<u8> = (0..3 * pixels).map(|_| random.between(0.0, 255.0) as u8).collect();
    // The first step compiles the passes.
    step(&mut backend, TargetRgb::Bytes(&rgb), channels);
    // The call of a step may return before the graphics card has finished the step. The next call waits until it has.
    bencher.bench_local(|| step(&mut backend, TargetRgb::Bytes(&rgb), channels));
}
