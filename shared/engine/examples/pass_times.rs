//! Prints how long each pass of a training step takes on a graphics card, measured with the card's own clock, and how
//! near it comes to the fewest bytes that it must move. The model is a ground of discs that fills the pictures and is
//! seen as a whole, and the steps have surface losses.
//!
//! `cargo run --release -p cosurf-engine --features gpu-timestamps --example pass_times -- gpu SPLATS WIDTHxHEIGHT`

use std::collections::BTreeMap;
use std::time::Instant;

use cosurf_engine::backend::{
    AdamRates, BinCounts, Channels, LossWeights, MultiviewWeights, PatchSide, SurfaceWeights, TargetRgb,
    Targets,
};
use cosurf_engine::budget::PAIRS_PER_SEEN_SPLAT;
use cosurf_engine::{AnyBackend, Backend, Capacity, Device, DeviceChoice, Schedule};
use cosurf_scene::{Camera, Pose, Splats};
use glam::{DVec2, DVec3};

/// Number of splats and size of the pictures where the command line names none.
const SPLATS: &str = "20000";
const SIZE_PX: &str = "480x270";
const STEPS: u32 = 20;
/// Height of the cameras above the ground and breadth of the ground, world units.
const HEIGHT: f64 = 6.0;
const BREADTH: f64 = 8.0;
/// Steps of the sort of the splats of one view by depth; the other steps sort pairs by tile.
const DEPTH_DIGITS: f64 = 4.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let argument = |place: usize, default| arguments.get(place).map_or(default, String::as_str);
    let choice: DeviceChoice = argument(0, "gpu").parse()?;
    let splats: usize = argument(1, SPLATS).parse()?;
    let (width, height) = argument(2, SIZE_PX).split_once('x').ok_or("the size is not WIDTHxHEIGHT")?;
    let size_px: [u32; 2] = [width.parse()?, height.parse()?];
    let device = choice.open()?;
    let Device::Gpu(gpu) = &device else { return Err(format!("{device} is no graphics card").into()) };
    let mut scene = Scene::new(&device, splats, size_px)?;
    // The first step compiles the passes.
    scene.step();
    if gpu.take_pass_times().is_none() {
        return Err(format!("{device} has no timestamps: its passes cannot be measured").into());
    }
    let mut times: BTreeMap<&str, (usize, f64)> = BTreeMap::new();
    let start = Instant::now();
    for _ in 0..STEPS {
        scene.step();
        for time in gpu.take_pass_times().unwrap_or_default() {
            let (dispatches, milliseconds) = times.entry(time.name).or_default();
            (*dispatches, *milliseconds) = (*dispatches + time.dispatches, *milliseconds + time.milliseconds);
        }
    }
    let elapsed = start.elapsed();
    device.check()?;
    println!("{device}: {} × {} px, {}", size_px[0], size_px[1], scene.sizes());
    print_table(&scene, times.into_iter().collect());
    println!("{:<40}{:>12.3}", "by the clock", 1e3 * elapsed.as_secs_f64() / f64::from(STEPS));
    Ok(())
}

/// Prints one line for each pass, the slowest first. The bytes are the fewest that its dispatches of a step must move.
fn print_table(scene: &Scene, mut times: Vec<(&str, (usize, f64))>) {
    times.sort_by(|(_, (_, a)), (_, (_, b))| b.total_cmp(a));
    let (steps, all) = (f64::from(STEPS), times.iter().map(|(_, (_, time))| time).sum::<f64>());
    println!(
        "{:<28}{:>12}{:>12}{:>8}{:>12}{:>12}",
        "pass", "dispatches", "ms a step", "share", "MB a step", "GB/s"
    );
    let mut bytes_all = 0.0;
    for (name, (dispatches, time)) in times {
        let dispatches = dispatches as f64 / steps;
        let (milliseconds, bytes) = (time / steps, scene.bytes(name, dispatches));
        bytes_all += bytes;
        println!(
            "{name:<28}{dispatches:>12}{milliseconds:>12.3}{:>7.1}%{:>12.2}{:>12.1}",
            100.0 * time / all,
            bytes * 1e-6,
            bytes * 1e-6 / milliseconds,
        );
    }
    let milliseconds = all / steps;
    println!(
        "{:<40}{milliseconds:>12.3}{:>20.2}{:>12.1}",
        "all",
        bytes_all * 1e-6,
        bytes_all * 1e-6 / milliseconds
    );
}

/// A model in training, and a photograph that both views share.
struct Scene {
    backend: AnyBackend,
    size_px: [u32; 2],
    photograph: Vec<u8>,
    rates: AdamRates,
    counts: BinCounts,
}

impl Scene {
    fn new(device: &Device, splats: usize, size_px: [u32; 2]) -> Result<Self, Box<dyn std::error::Error>> {
        let splats = ground(splats, size_px);
        let capacity = Capacity {
            splats: splats.len(),
            pairs: PAIRS_PER_SEEN_SPLAT * splats.len(),
            size_px,
            sh_degree: 3,
            channels: Channels::Geometry,
            training: true,
        };
        let mut backend = AnyBackend::new(device, capacity, 1)?;
        backend.load(&splats);
        let photograph = (0..3 * size_px[0] * size_px[1]).map(|i| (i * 37 % 251) as u8).collect();
        let rates = Schedule::new(30_000).rates(0, 4.0);
        Ok(Self { backend, size_px, photograph, rates, counts: BinCounts::default() })
    }

    /// One training step with surface losses.
    fn step(&mut self) {
        let Self { backend, size_px, photograph, rates, counts } = self;
        backend.project(&camera(0.5, *size_px), 0);
        backend.bin();
        backend.rasterize(Channels::Geometry);
        backend.keep_neighbour();
        backend.project(&camera(0.0, *size_px), 3);
        backend.bin();
        backend.rasterize(Channels::Geometry);
        let rgb = TargetRgb::Bytes(photograph);
        let multiview =
            MultiviewWeights { reprojection: 0.05, ncc: 1.0, cell_px: 2, patch: PatchSide::Px3, draw: 1 };
        let weights = LossWeights {
            ssim: 0.2,
            scale: 25.0,
            surface: Some(SurfaceWeights { normal: 0.04, multiview: Some(multiview) }),
            teacher: None,
        };
        backend.losses(&Targets { neighbour_rgb: Some(rgb), ..Targets::colors(rgb) }, &weights);
        *counts = backend.counts();
        backend.rasterize_backward();
        backend.project_backward();
        backend.adam(rates);
    }

    fn sizes(&self) -> String {
        let BinCounts { visible, pairs, dropped } = self.counts;
        format!("{} splats, {visible} visible, {pairs} pairs ({dropped} dropped)", self.backend.len())
    }

    /// The fewest bytes that the dispatches of a pass must move in a step: each number that one needs is read once, each
    /// that it yields is written once. 0 for the passes that take next to no time.
    fn bytes(&self, pass: &str, dispatches: f64) -> f64 {
        let [splats, visible, pairs] =
            [self.backend.len(), self.counts.visible, self.counts.pairs].map(|count| count as f64);
        let pixels = f64::from(self.size_px[0]) * f64::from(self.size_px[1]);
        // Numbers of 4 bytes: 11 of a splat's shape, 48 of its colours, 16 of a projected splat or of a record.
        let (shape, sh, projected, record) = (44.0, 192.0, 64.0, 64.0);
        let sorted = 2.0 * DEPTH_DIGITS * visible + (dispatches - 2.0 * DEPTH_DIGITS) * pairs;
        let bytes = match pass {
            // A key; then a key and its value, read and written.
            "sort_count" => return 4.0 * sorted,
            "sort_scatter" => return 16.0 * sorted,
            // Of the two views of a step, only one has colours of a degree above 0.
            "project" => splats * (shape + 16.0) + visible * (0.5 * (sh + 12.0) + projected),
            "compact" => splats * 8.0 + visible * 8.0,
            "order_counts" => visible * 12.0,
            "emit" => visible * (projected + 16.0) + pairs * 12.0,
            "tile_ranges" => pairs * 4.0,
            "rasterize" | "rasterize_by_pixel" => visible * projected + pairs * 8.0 + pixels * 32.0,
            "rasterize_backward" | "rasterize_backward_by_pixel" => {
                visible * projected + pairs * (8.0 + record) + pixels * 64.0
            }
            "project_backward" => visible * (shape + sh + projected + 8.0 + 56.0 + 24.0) + pairs * record,
            "adam" => splats * (56.0 + 6.0 * shape + 6.0 * sh),
            "ssim" => pixels * (12.0 + 3.0 + 36.0),
            "photometric_gradient" => pixels * (36.0 + 12.0 + 3.0 + 12.0),
            "unbiased_depth" => pixels * 20.0,
            "luma" => pixels * 7.0,
            "edges" => pixels * 4.0,
            "normals" => pixels * (32.0 + 8.0 + 32.0),
            "depth_backward" => pixels * (16.0 + 16.0 + 32.0),
            "multiview" => pixels * (16.0 + 16.0),
            _ => 0.0,
        };
        dispatches * bytes
    }
}

fn camera(x: f64, size_px: [u32; 2]) -> Camera {
    let [width, height] = size_px.map(f64::from);
    // The ground is as broad as the picture.
    let focal_px = width * HEIGHT / BREADTH;
    Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, 0.0, HEIGHT), DVec3::new(x, 0.0, 0.0), DVec3::Y),
        focal_px: DVec2::splat(focal_px),
        center_px: DVec2::new(width, height) / 2.0,
        size_px,
    }
}

/// About `count` discs in many colours that fill pictures of this shape.
fn ground(count: usize, size_px: [u32; 2]) -> Splats {
    let [width, height] = size_px.map(f64::from);
    let across = (count as f64 * width / height).sqrt().round() as usize;
    let down = count.div_ceil(across);
    let spacing = BREADTH / across as f64;
    let log_scale = (0.72 * spacing).ln() as f32;
    let mut splats = Splats::with_capacity(across * down, 3);
    for i in 0..across * down {
        let x = (BREADTH * ((i % across) as f64 / across as f64 - 0.5)) as f32;
        let y = (BREADTH * height / width * ((i / across) as f64 / down as f64 - 0.5)) as f32;
        let mut sh = [0.0; 48];
        sh[..3].copy_from_slice(&[(x * 1.7).sin(), (y * 1.3).cos(), (x * y * 0.4).sin()]);
        let log_scales = [log_scale, log_scale - 0.2, log_scale - 2.8];
        splats.push([x, y, 0.1 * (2.0 * x).sin()], [1.0, 0.0, 0.0, 0.0], log_scales, 1.0, &sh);
    }
    splats
}
