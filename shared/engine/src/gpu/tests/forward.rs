//! Compares the pictures of both backends pixel by pixel. Pixels may differ where rounding decides whether alpha
//! reaches 1/255, whether a pixel is full, or which of two splats is nearer. Such pixels are called ties. They are
//! counted and must be few.

use cosurf_scene::{Camera, Splats};
use glam::{DVec2, DVec3};

use super::adapter::{both, gpu};
use crate::backend::Rendering;
use crate::cpu::tests::{self, splats};
use crate::gpu::Gpu;
use crate::gpu::render::GpuRenderer;
use crate::render::Renderer;

/// Largest difference of a value that is not a tie. Differences of depth are relative, or absolute below a depth of 1;
/// all others are absolute.
const TOLERANCE: f32 = 1e-3;
/// Share of pixels that may be ties.
const TIES_MAX: f64 = 1e-3;

fn camera(eye: DVec3, focal_px: f64, center_px: DVec2, size_px: [u32; 2]) -> Camera {
    Camera { size_px, ..tests::camera(eye, focal_px, center_px) }
}

pub(super) fn centered(eye: DVec3, focal_px: f64, size_px: [u32; 2]) -> Camera {
    camera(eye, focal_px, DVec2::from(size_px.map(f64::from)) / 2.0, size_px)
}

fn cases() -> Vec<(&'static str, Splats, Camera)> {
    let eye = DVec3::new(3.0, 2.0, 1.5);
    let small = [44, 29];
    vec![
        ("no splats", Splats::with_capacity(0, 2), centered(eye, 40.0, small)),
        ("one splat", splats(1, 0.1, -0.5, 2.0, 3, 1), centered(eye, 40.0, small)),
        ("one pixel", splats(200, 0.4, -1.5, 0.0, 1, 2), centered(eye, 10.0, [1, 1])),
        ("rotated", splats(14, 0.4, -1.6, 0.0, 3, 3), centered(eye, 40.0, small)),
        ("off-centre", splats(200, 0.6, -1.5, 0.5, 2, 4), camera(-eye, 55.0, DVec2::new(9.0, 33.0), small)),
        // A wide angle and large splats behind, beside and at the camera, so that slopes are clamped.
        ("clamped", splats(2000, 2.2, -0.8, 0.0, 1, 5), centered(eye, 14.0, small)),
        (
            "inside",
            splats(3000, 1.0, -2.0, 0.0, 0, 6),
            centered(DVec3::new(0.1, 0.2, 0.0), 100.0, [200, 150]),
        ),
        // Many pixels become full, and many alphas are clamped.
        ("opaque", splats(3000, 0.5, -2.2, 4.0, 0, 7), centered(eye, 300.0, [300, 210])),
        ("many", splats(20_000, 0.8, -3.4, 0.0, 3, 8), centered(eye, 300.0, [480, 270])),
        ("wide", splats(2000, 0.8, -3.0, 0.0, 1, 9), centered(eye, 3000.0, [8192, 40])),
        ("tall", splats(500, 0.8, -3.0, 0.0, 1, 10), centered(eye, 3000.0, [20, 5000])),
    ]
}

/// Number of pixels that differ by more than the tolerance, and the largest difference of all other pixels.
fn compare(a: &Rendering, b: &Rendering) -> (usize, f32) {
    assert_eq!(a.size_px, b.size_px);
    let pixels = (a.size_px[0] * a.size_px[1]) as usize;
    let (mut ties, mut worst) = (0, 0.0f32);
    for i in 0..pixels {
        let values = |r: &Rendering| -> Vec<f32> {
            [&r.rgb[3 * i..3 * i + 3], &r.normal[3 * i..3 * i + 3], &r.alpha[i..=i]].concat()
        };
        let difference = values(a).into_iter().zip(values(b)).map(|(a, b)| (a - b).abs());
        let depth = (a.depth[i] - b.depth[i]).abs() / b.depth[i].max(1.0);
        let difference = difference.fold(depth, |most, d| if d <= most { most } else { d });
        if difference <= TOLERANCE {
            worst = worst.max(difference);
        } else {
            ties += 1;
        }
    }
    (ties, worst)
}

#[test]
fn pictures_agree_with_the_cpu() {
    both().iter().for_each(pictures_agree);
}

fn pictures_agree(gpu: &Gpu) {
    for (name, splats, camera) in cases() {
        let expected = Renderer::new(&splats, 2).render(&camera);
        let mut renderer = GpuRenderer::new(gpu, &splats).expect("room");
        let got = renderer.render(&camera, f64::INFINITY).expect("room");
        let pixels = got.alpha.len();
        let (ties, worst) = compare(&got, &expected);
        println!("{name}: {ties} ties of {pixels} pixels, otherwise within {worst:.1e}");
        assert!(ties as f64 <= TIES_MAX * pixels as f64, "{name}: {ties} of {pixels} pixels differ");
        let again = renderer.render(&camera, f64::INFINITY).expect("room");
        assert_eq!(got, again, "{name}: the same bits again");
        if splats.is_empty() {
            continue;
        }
        // The comparison must also notice a wrong model: one in which every 50th splat is larger by a factor of e^0.2
        // (every splat if the picture has only one pixel).
        assert!(expected.alpha.iter().any(|alpha| *alpha > 0.3), "{name} shows something");
        let mut wrong = splats.clone();
        let every = if pixels == 1 { 1 } else { 50 };
        wrong.log_scales.iter_mut().step_by(every).for_each(|s| *s = s.map(|v| v + 0.2));
        let wrong = Renderer::new(&wrong, 2).render(&camera);
        assert!(
            compare(&got, &wrong).0 as f64 > TIES_MAX * pixels as f64,
            "{name}: a wrong model went unnoticed"
        );
    }
}

#[test]
fn what_lies_too_deep_is_left_out_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let has_many = |(_, splats, camera): &(_, Splats, Camera)| splats.len() > 100 && camera.size_px != [1, 1];
    let mut changed = 0;
    for (name, splats, camera) in cases().into_iter().filter(has_many) {
        let depth = |mean: &[f32; 3]| camera.cam_from_world.transform(DVec3::from(mean.map(f64::from))).z;
        let mut depths: Vec<f64> = splats.means.iter().map(depth).collect();
        depths.retain(|depth| *depth > 0.5);
        depths.sort_unstable_by(f64::total_cmp);
        let far = depths[depths.len() / 4] + 1e-4;
        let mut on_cpu = Renderer::new(&splats, 2);
        let [all, expected] =
            [f64::INFINITY, far].map(|far| on_cpu.try_render_up_to(&camera, far).expect("the CPU stays"));
        let got = GpuRenderer::new(&gpu, &splats).expect("room").render(&camera, far).expect("room");
        let ties_max = TIES_MAX * got.alpha.len() as f64;
        let (ties, worst) = compare(&got, &expected);
        assert!(ties as f64 <= ties_max, "{name}: {ties} pixels differ, the others by up to {worst:.1e}");
        changed += usize::from(compare(&got, &all).0 as f64 > ties_max);
    }
    assert!(changed >= 5, "only {changed} pictures show that most of the splats are left out");
}
