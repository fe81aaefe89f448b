//! A training step on the CPU allocates nothing: every buffer has its size from the start.
//!
//! A global allocator counts the allocations of all threads. The first step is not counted, because it wakes up the
//! threads of the pool. Where the test calls the passes itself, this first step has a tiny picture.
#![allow(clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use cosurf_engine::backend::{
    AdamRates, Channels, LossWeights, MultiviewWeights, PatchSide, SurfaceWeights, TargetRgb, TargetSurface,
    Targets, TeacherWeights,
};
use cosurf_engine::{
    Backend, Capacity, CpuBackend, Example, Neighbours, PoseChoice, Rendering, Schedule, SurfaceSettings,
    TrainSettings, Trainer, TrainingViews,
};
use cosurf_scene::{Camera, Pose, SparsePoint, Splats};
use glam::{DVec2, DVec3};

/// Number of allocations of the whole process.
static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

struct Counting;

#[global_allocator]
static COUNTING: Counting = Counting;

// SAFETY: every call goes to the system's allocator unchanged, and only increments a counter besides.
#[allow(unsafe_code)]
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(memory, layout, size) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(memory, layout) }
    }
}

fn allocations_of(work: impl FnOnce()) -> usize {
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    work();
    ALLOCATIONS.load(Ordering::Relaxed) - before
}

const SIZE_PX: [u32; 2] = [150, 110];
const STEPS: usize = 30;
/// Number of passes of the longest step: 4 for the neighbouring view, then 7 for the view.
const PASSES: usize = 4 + 7;
/// Largest number of allocations that rayon makes in [`STEPS`] steps. It allocates a block of its queue for every 63rd
/// job from outside its pool, and each pass is such a job. It also enlarges the queues of its threads now and then,
/// more often while other programs use the cores.
const RAYON_ALLOCATIONS_MAX: usize = STEPS * PASSES / 63 + 8;

fn camera(x: f64, size_px: [u32; 2]) -> Camera {
    Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, 0.0, 6.0), DVec3::new(0.5 * x, 0.0, 0.0), DVec3::Y),
        focal_px: DVec2::splat(0.8 * f64::from(size_px[0])),
        center_px: DVec2::from(size_px.map(f64::from)) / 2.0,
        size_px,
    }
}

/// A ground of 60 × 60 discs.
fn ground() -> Splats {
    let mut splats = Splats::with_capacity(3600, 1);
    for i in 0..3600u16 {
        let [x, y] = [i % 60, i / 60].map(|v| (f32::from(v) - 29.5) * 0.12);
        let mut sh = [0.0; 12];
        sh[..3].copy_from_slice(&[(x * 1.7).sin(), (y * 1.3).cos(), (x * y * 0.4).sin()]);
        splats.push([x, y, 0.1 * x.sin()], [1.0, 0.0, 0.0, 0.0], [-2.6, -2.7, -6.0], 2.0, &sh);
    }
    splats
}

fn backend(splats: &Splats, channels: Channels) -> CpuBackend {
    let cameras = [camera(0.0, SIZE_PX)];
    let mut backend = CpuBackend::new(Capacity::to_train(splats, &cameras, channels), 2);
    backend.load(splats);
    backend
}

/// A rendering that serves as photograph and as teacher.
fn shown(splats: &Splats, camera: &Camera) -> Rendering {
    cosurf_engine::Renderer::new(splats, 1).render(camera)
}

fn weights(channels: Channels) -> LossWeights {
    let multiview =
        MultiviewWeights { reprojection: 0.05, ncc: 1.0, cell_px: 2, patch: PatchSide::Px3, draw: 3 };
    let is_surface = channels == Channels::Geometry;
    LossWeights {
        ssim: 0.2,
        scale: 1.0,
        surface: is_surface.then_some(SurfaceWeights { normal: 0.04, multiview: Some(multiview) }),
        teacher: is_surface.then_some(TeacherWeights { depth: 0.1, normal: 0.1 }),
    }
}

/// One training step. If surfaces are trained, it has a neighbouring view and a teacher.
fn step(backend: &mut CpuBackend, views: &[(Camera, Rendering); 2], channels: Channels, rates: &AdamRates) {
    let [(here, shown), (there, neighbour)] = views;
    let is_surface = channels == Channels::Geometry;
    if is_surface {
        backend.project(there, 0);
        backend.bin();
        backend.rasterize(channels);
        backend.keep_neighbour();
    }
    backend.project(here, 1);
    backend.bin();
    assert_eq!(backend.counts().dropped, 0);
    backend.rasterize(channels);
    let surface = TargetSurface { depth: &shown.depth, normal: &shown.normal, trust: &shown.alpha };
    let targets = Targets {
        neighbour_rgb: is_surface.then_some(TargetRgb::Floats(&neighbour.rgb)),
        surface: is_surface.then_some(surface),
        ..Targets::colors(TargetRgb::Floats(&shown.rgb))
    };
    let losses = backend.losses(&targets, &weights(channels));
    assert_eq!(losses.surface.matched > 0.1, is_surface, "{losses:?}");
    backend.rasterize_backward();
    backend.project_backward();
    backend.adam(rates);
}

/// One test makes all counts, because tests of one program run at the same time and would count each other's
/// allocations.
#[test]
fn a_step_allocates_nothing() {
    let splats = ground();
    let rates = Schedule::new(1000).rates(0, 4.0);
    let pair = |size_px| [0.0, 0.7].map(|x| camera(x, size_px)).map(|view| (view, shown(&splats, &view)));
    let (tiny, full) = (pair([24, 20]), pair(SIZE_PX));
    for channels in [Channels::Color, Channels::Geometry] {
        let mut backend = backend(&splats, channels);
        step(&mut backend, &tiny, channels, &rates);
        let count = allocations_of(|| (0..STEPS).for_each(|_| step(&mut backend, &full, channels, &rates)));
        assert!(count <= RAYON_ALLOCATIONS_MAX, "{channels:?}: {count} allocations in {STEPS} steps");
    }
    trainings_step_allocates_nothing(&splats, &full);
    // The counter must detect one allocation in each step.
    let mut backend = backend(&splats, Channels::Color);
    let count = allocations_of(|| (0..STEPS).for_each(|_| drop(backend.take_shapes())));
    assert!(count > RAYON_ALLOCATIONS_MAX, "{count} allocations went unnoticed");
}

fn trainings_step_allocates_nothing(splats: &Splats, views: &[(Camera, Rendering); 2]) {
    let cameras = views.each_ref().map(|(camera, _)| *camera).to_vec();
    let points: Vec<SparsePoint> = (splats.means.iter().step_by(50))
        .map(|mean| SparsePoint {
            position: DVec3::from_array(mean.map(f64::from)),
            rgb: [0; 3],
            views: vec![0, 1],
        })
        .collect();
    let neighbours = Neighbours::find(&cameras, &points);
    assert_eq!(neighbours.nearest(0), Some(1));
    let mut schedule = Schedule::new(1000);
    schedule.surface_from = 0;
    let settings = TrainSettings {
        schedule,
        extent: 4.0,
        sh_degree: 1,
        surface: Some(SurfaceSettings::default()),
        prune: None,
        exposure: true,
        poses: PoseChoice::Fixed,
        observers_min: 2,
        splats_max: splats.len(),
        seed: 3,
    };
    let backend = backend(splats, Channels::Geometry);
    let mut trainer = Trainer::new(backend, settings, TrainingViews { cameras, neighbours });
    let example = |view: usize| {
        let rgb = |view: usize| TargetRgb::Floats(&views[view].1.rgb);
        Example { view, rgb: rgb(view), neighbour: Some((1 - view, rgb(1 - view))) }
    };
    trainer.step(&example(0));
    let count = allocations_of(|| {
        for i in 0..STEPS {
            trainer.step(&example(i % 2));
        }
    });
    assert!(count <= RAYON_ALLOCATIONS_MAX, "training: {count} allocations in {STEPS} steps");
}
