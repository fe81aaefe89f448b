//! Prints how long each pass of a training step takes on a graphics card, measured with the card's own clock. The
//! pictures have 480 × 270 px, the model has about 20,000 splats, and the steps have surface losses.
//!
//! `cargo run --release -p cosurf-engine --features gpu-timestamps --example pass_times -- [gpu|gpu:N]`

use std::collections::BTreeMap;

use cosurf_engine::backend::{
    AdamRates, Channels, LossWeights, MultiviewWeights, SurfaceWeights, TargetRgb, Targets,
};
use cosurf_engine::budget::PAIRS_PER_SEEN_SPLAT;
use cosurf_engine::{AnyBackend, Backend, Capacity, Device, DeviceChoice, Schedule};
use cosurf_scene::{Camera, Pose, Splats};
use glam::{DVec2, DVec3};

const SIZE_PX: [u32; 2] = [480, 270];
/// Number of splats along each side of the ground.
const SIDE: u32 = 142;
const STEPS: u32 = 20;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let choice: DeviceChoice = std::env::args().nth(1).as_deref().unwrap_or("gpu").parse()?;
    let device = choice.open()?;
    let Device::Gpu(gpu) = &device else { return Err(format!("{device} is no graphics card").into()) };
    let splats = ground();
    let capacity = Capacity {
        splats: splats.len(),
        pairs: PAIRS_PER_SEEN_SPLAT * splats.len(),
        size_px: SIZE_PX,
        sh_degree: 3,
        channels: Channels::Geometry,
        training: true,
    };
    let mut backend = AnyBackend::new(&device, capacity, 1)?;
    backend.load(&splats);
    let photograph: Vec<u8> = (0..3 * SIZE_PX[0] * SIZE_PX[1]).map(|i| (i * 37 % 251) as u8).collect();
    let rates = Schedule::new(30_000).rates(0, 4.0);
    // The first step compiles the passes.
    step(&mut backend, &photograph, &rates);
    if gpu.take_pass_times().is_none() {
        return Err(format!("{device} has no timestamps: its passes cannot be measured").into());
    }
    let mut times: BTreeMap<&str, (usize, f64)> = BTreeMap::new();
    for _ in 0..STEPS {
        step(&mut backend, &photograph, &rates);
        for time in gpu.take_pass_times().unwrap_or_default() {
            let (dispatches, milliseconds) = times.entry(time.name).or_default();
            (*dispatches, *milliseconds) = (*dispatches + time.dispatches, *milliseconds + time.milliseconds);
        }
    }
    device.check()?;
    print_table(&device, times.into_iter().collect());
    Ok(())
}

/// Prints one line for each pass, the slowest first.
fn print_table(device: &Device, mut times: Vec<(&str, (usize, f64))>) {
    times.sort_by(|(_, (_, a)), (_, (_, b))| b.total_cmp(a));
    let (steps, all) = (f64::from(STEPS), times.iter().map(|(_, (_, time))| time).sum::<f64>());
    println!("{device}: {STEPS} steps");
    println!("{:<22}{:>14}{:>12}{:>8}", "pass", "dispatches", "ms a step", "share");
    for (name, (dispatches, time)) in times {
        println!("{name:<22}{dispatches:>14}{:>12.3}{:>7.1}%", time / steps, 100.0 * time / all);
    }
    println!("{:<36}{:>12.3}", "all", all / steps);
}

fn camera(x: f64) -> Camera {
    Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, 0.0, 6.0), DVec3::new(x, 0.0, 0.0), DVec3::Y),
        focal_px: DVec2::splat(400.0),
        center_px: DVec2::from(SIZE_PX.map(f64::from)) / 2.0,
        size_px: SIZE_PX,
    }
}

/// A ground of discs in many colours that fills the pictures.
fn ground() -> Splats {
    let mut splats = Splats::with_capacity((SIDE * SIDE) as usize, 3);
    for i in 0..SIDE * SIDE {
        let [x, y] = [i % SIDE, i / SIDE].map(|v| v as f32 / SIDE as f32 - 0.5);
        let (x, y) = (8.0 * x, 5.0 * y);
        let mut sh = [0.0; 48];
        sh[..3].copy_from_slice(&[(x * 1.7).sin(), (y * 1.3).cos(), (x * y * 0.4).sin()]);
        splats.push([x, y, 0.1 * (2.0 * x).sin()], [1.0, 0.0, 0.0, 0.0], [-3.2, -3.4, -6.0], 1.0, &sh);
    }
    splats
}

/// One training step with surface losses.
fn step(backend: &mut AnyBackend, photograph: &[u8], rates: &AdamRates) {
    backend.project(&camera(0.5), 0);
    backend.bin();
    backend.rasterize(Channels::Geometry);
    backend.keep_neighbour();
    backend.project(&camera(0.0), 3);
    backend.bin();
    backend.rasterize(Channels::Geometry);
    let rgb = TargetRgb::Bytes(photograph);
    let multiview = MultiviewWeights { reprojection: 0.05, ncc: 1.0, cell_px: 2, draw: 1 };
    let weights = LossWeights {
        ssim: 0.2,
        scale: 25.0,
        surface: Some(SurfaceWeights { normal: 0.04, multiview: Some(multiview) }),
        teacher: None,
    };
    backend.losses(&Targets { neighbour_rgb: Some(rgb), ..Targets::colors(rgb) }, &weights);
    backend.rasterize_backward();
    backend.project_backward();
    backend.adam(rates);
}
