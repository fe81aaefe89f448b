//! Random splats, a sequence of cameras, and the models of agents.

use std::fs;
use std::path::Path;

use anyhow::Result;
use cosurf_link::Model;
use cosurf_scene::{Camera, LocalFrame, Pose, Splats, ply};
use glam::{DQuat, DVec2, DVec3};

/// A generator of pseudo-random floats in -1..1 (xorshift). Different seeds give different sequences.
pub fn noise(seed: u64) -> impl FnMut() -> f32 {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

/// Random splats in a box of 200 × 200 × 20 m around the origin.
pub fn random_splats(seed: u64, count: usize, sh_degree: u32) -> Splats {
    let mut splats = Splats::with_capacity(count, sh_degree);
    let mut noise = noise(seed);
    for _ in 0..count {
        let mean = [100.0 * noise(), 100.0 * noise(), 10.0 * noise()];
        let quat = [1.5 + noise(), noise(), noise(), noise()];
        let log_scale = [3.0 * noise(), 3.0 * noise(), 3.0 * noise()];
        let logit = 5.0 * noise();
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|_| noise()).collect();
        splats.push(mean, quat, log_scale, logit, &sh);
    }
    splats
}

/// Cameras of 640 × 480 pixels. From each camera to the next, the x translation of `cam_from_world` grows by 1 m, its
/// rotation about x by 0.1 rad, and the principal point moves by 1 px.
pub fn cameras(count: usize) -> Vec<Camera> {
    let camera = |i: usize| Camera {
        cam_from_world: Pose {
            rotation: DQuat::from_rotation_x(0.1 * i as f64),
            translation: DVec3::new(i as f64, 0.1, -3.3),
        },
        focal_px: DVec2::new(500.25, 501.5),
        center_px: DVec2::new(319.1 + i as f64, 240.7),
        size_px: [640, 480],
    };
    (0..count).map(camera).collect()
}

/// Reads the model in an agent's output folder.
pub fn read_model(agent: &Path) -> Result<Model> {
    let splats = ply::read(&agent.join("model.ply"), &LocalFrame::WORLD)?;
    let cameras = serde_json::from_slice(&fs::read(agent.join("cameras.json"))?)?;
    Ok(Model { splats, cameras })
}
