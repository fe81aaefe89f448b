//! Two benchmarks. One fuses 16 views of 480 × 360 pixels over rolling ground, without rendering them; its
//! throughput is in pixels of the views. The other compares the fused mesh with itself; its throughput is in
//! triangles.
//!
//! `cargo bench -p cosurf-aggregator`

use std::ops::ControlFlow;

use cosurf_aggregator::evaluate::accuracy::judge;
use cosurf_aggregator::mesh::{FuseSettings, fuse};
use cosurf_engine::Rendering;
use cosurf_scene::{Camera, Mesh, Pose};
use divan::Bencher;
use divan::counter::ItemsCount;
use glam::{DVec2, DVec3};

const SIZE_PX: [u32; 2] = [480, 360];

fn main() {
    divan::main();
}

/// Four by four cameras 100 m above the ground, looking down.
fn cameras() -> Vec<Camera> {
    let camera = |i: i32| {
        let eye = DVec3::new(f64::from(i % 4) * 25.0, f64::from(i / 4) * 25.0, 100.0);
        Camera {
            cam_from_world: Pose::look_at(eye, eye.with_z(0.0), DVec3::Y),
            focal_px: DVec2::splat(415.0),
            center_px: DVec2::new(240.0, 180.0),
            size_px: SIZE_PX,
        }
    };
    (0..16).map(camera).collect()
}

/// Renders ground that rolls by 2 m up and down, seen from above. The depth is nearly the camera's height
/// minus the height of the ground.
fn look(camera: &Camera) -> Rendering {
    let [width, height] = camera.size_px;
    let eye = camera.cam_from_world.center();
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let depth: Vec<f32> = pixels
        .map(|(x, y)| {
            let ray = camera.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            let (east, north) = (eye.x + 100.0 * ray.x, eye.y - 100.0 * ray.y);
            (100.0 - 2.0 * (east / 7.0).sin() * (north / 5.0).sin()) as f32
        })
        .collect();
    let pixels = depth.len();
    Rendering {
        size_px: camera.size_px,
        rgb: vec![0.5; 3 * pixels],
        alpha: vec![1.0; pixels],
        depth,
        normal: Vec::new(),
    }
}

const SETTINGS: FuseSettings = FuseSettings { voxel_m: None, memory_bytes: 1 << 30 };

fn fused() -> Mesh {
    fuse(&cameras(), look, &SETTINGS, |_| ControlFlow::Continue(())).expect("the ground is seen").mesh
}

#[divan::bench(sample_count = 10)]
fn fuse_views(bencher: Bencher) {
    let cameras = cameras();
    // Every camera is rendered when it is first asked for, and kept. So only the first iteration renders.
    let mut views: Vec<(Camera, Rendering)> = Vec::new();
    let mut shown = |camera: &Camera| match views.iter().find(|(seen, _)| seen == camera) {
        Some((_, rendering)) => rendering.clone(),
        None => {
            views.push((*camera, look(camera)));
            look(camera)
        }
    };
    let pixels = cameras.len() * (SIZE_PX[0] * SIZE_PX[1]) as usize;
    bencher
        .counter(ItemsCount::new(pixels))
        .bench_local(|| fuse(&cameras, &mut shown, &SETTINGS, |_| ControlFlow::Continue(())));
}

#[divan::bench(sample_count = 3)]
fn judge_mesh(bencher: Bencher) {
    let mesh = fused();
    bencher.counter(ItemsCount::new(mesh.triangles.len())).bench(|| judge(&mesh, &mesh, 0.5, 0));
}
