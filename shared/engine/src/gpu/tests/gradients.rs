//! Compares losses, gradients and statistics of a step on both backends.

use cosurf_scene::{Camera, Splats};
use glam::DVec3;

use super::adapter::both;
use super::compare::{TIES_MAX, compare, off_of, on_cpu, on_gpu};
use super::forward::centered;
use crate::backend::{Backend, Channels, Exposure, LossWeights, Losses, SurfaceWeights, TargetRgb, Targets};
use crate::cpu::tests::splats;
use crate::gpu::Gpu;
use crate::random::{Purpose, Random};

pub(super) fn cases() -> Vec<(&'static str, Splats, Camera)> {
    let eye = DVec3::new(3.0, 2.0, 1.5);
    vec![
        ("no splats", Splats::with_capacity(0, 1), centered(eye, 40.0, [20, 20])),
        ("one pixel", splats(60, 0.4, -1.5, 0.0, 1, 2), centered(eye, 10.0, [1, 1])),
        ("rotated", splats(14, 0.4, -1.6, 0.0, 3, 3), centered(eye, 40.0, [44, 29])),
        // A wide angle and splats behind and beside the camera, so that slopes are clamped.
        ("clamped", splats(500, 2.2, -0.8, 0.0, 2, 5), centered(eye, 14.0, [44, 29])),
        // Tiles with more pairs than a workgroup processes at a time, and full pixels.
        ("opaque", splats(2000, 0.5, -2.2, 3.0, 0, 7), centered(eye, 120.0, [120, 90])),
        ("wide", splats(600, 0.6, -3.0, 0.0, 1, 9), centered(eye, 400.0, [8192, 48])),
        ("many", splats(5000, 0.8, -3.0, 0.0, 3, 8), centered(eye, 150.0, [230, 140])),
    ]
}

/// A photograph of noise, in bytes.
fn noise(size_px: [u32; 2]) -> Vec<u8> {
    let mut random = Random::new(11, Purpose::Test, 0, 0);
    (0..3 * size_px[0] * size_px[1]).map(|_| random.below(256) as u8).collect()
}

fn weights(channels: Channels) -> LossWeights {
    let surface = SurfaceWeights { normal: 0.3, multiview: None };
    LossWeights {
        ssim: 0.2,
        scale: 0.5,
        surface: (channels == Channels::Geometry).then_some(surface),
        teacher: None,
    }
}

/// Runs the passes of one step up to the gradients, and returns losses and gradients.
pub(super) fn step(
    backend: &mut impl Backend,
    camera: &Camera,
    degree: u32,
    channels: Channels,
) -> (Losses, Splats) {
    let noise = noise(camera.size_px);
    let targets = Targets {
        exposure: Exposure { gain: 1.1, offset: -0.02 },
        ..Targets::colors(TargetRgb::Bytes(&noise))
    };
    backend.project(camera, degree);
    backend.bin();
    assert_eq!(backend.counts().dropped, 0);
    backend.rasterize(channels);
    let losses = backend.losses(&targets, &weights(channels));
    backend.rasterize_backward();
    backend.project_backward();
    (losses, backend.gradients())
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-4 * b.abs().max(0.01)
}

#[test]
fn gradients_agree_with_the_cpu() {
    both().iter().for_each(gradients_agree);
}

fn gradients_agree(gpu: &Gpu) {
    for (name, splats, camera) in cases() {
        for channels in [Channels::Color, Channels::Geometry] {
            let (mut gpu, mut cpu) = (on_gpu(gpu, &splats, camera.size_px), on_cpu(&splats, camera.size_px));
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
            // The comparison must also notice wrong gradients: every tenth number except those of opacities, whether
            // its splat is visible or not, is larger by 1 %.
            let mut bent = got.clone();
            bent.means.iter_mut().chain(&mut bent.log_scales).flatten().step_by(10).for_each(|v| *v *= 1.01);
            bent.quats.iter_mut().flatten().chain(&mut bent.sh).step_by(10).for_each(|v| *v *= 1.01);
            assert!(compare(&bent, &expected).1 as f64 > TIES_MAX * count as f64, "{name}: went unnoticed");
        }
    }
}
