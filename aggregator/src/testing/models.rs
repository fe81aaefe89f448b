//! Small models in memory. Most show parts of one coloured ground.

use cosurf_link::Model;
use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Camera, Pose, Splats};
use glam::{DVec2, DVec3};

/// `count` splats of degree `sh_degree`, with values derived from `seed`.
pub(crate) fn model(count: usize, sh_degree: u32, seed: f32) -> Model {
    let mut splats = Splats::with_capacity(count, sh_degree);
    let sh: Vec<f32> = (0..splats.sh_stride()).map(|i| seed + i as f32).collect();
    for i in 0..count {
        splats.push([seed, i as f32, 0.0], [1.0, 0.0, 0.0, 0.0], [-seed; 3], seed, &sh);
    }
    Model { splats, cameras: Vec::new() }
}

/// A camera 10 m above the ground point `(x, 0, 0)`, looking straight down.
pub(crate) fn above(x: f64) -> Camera {
    Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, 0.0, 10.0), DVec3::new(x, 0.0, 0.0), DVec3::Y),
        focal_px: DVec2::splat(40.0),
        center_px: DVec2::new(24.0, 16.0),
        size_px: [48, 32],
    }
}

/// The ground from x = `west` to `east`, 10 m wide: flat opaque splats, half a metre apart, coloured by
/// position.
pub(crate) fn ground(west: f32, east: f32) -> Splats {
    let mut splats = Splats::with_capacity(0, 0);
    for i in 0..((east - west) * 2.0) as i32 {
        for j in -10..10 {
            let (x, y) = (west + 0.5 * i as f32, 0.5 * j as f32);
            let shade = 0.5 + 0.3 * (1.3 * x).sin() * (0.9 * y).cos();
            let sh = [shade, 0.6 * shade, 1.0 - shade].map(|value| (value - 0.5) / SH_C0);
            splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.2, -1.2, -5.0], 4.0, &sh);
        }
    }
    splats
}

/// A small model of the ground around x = `place`, with two cameras of 24 × 16 pixels.
pub(crate) fn model_at(place: f32) -> Model {
    let cameras = [-0.5, 0.5].map(|x| above(f64::from(place) + x).resized([24, 16]));
    Model { splats: ground(place - 2.0, place + 2.0), cameras: cameras.to_vec() }
}
