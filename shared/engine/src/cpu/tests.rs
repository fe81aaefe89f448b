//! Compares the CPU backend with the f64 [`reference`] on every instruction set of this machine. Pictures are compared
//! directly. Gradients for every parameter of every splat are compared with central differences of the reference. The
//! cases are rotated and off-centre cameras, clamped slopes, nearly opaque splats, and splats on the border of the
//! picture.

mod bits;
mod loss;
mod reference;
mod surface;

use cosurf_scene::{Camera, Pose, Splats};
use glam::{DVec2, DVec3};

use super::backend::CpuBackend;
use crate::backend::{Backend, Channels};
use crate::budget::Capacity;
use crate::random::{Purpose, Random};
use crate::simd::{Isa, Row};
use reference::{Decisions, Pixel};

struct Case {
    name: &'static str,
    camera: Camera,
    splats: Splats,
    sh_degree: u32,
}

pub(crate) fn camera(eye: DVec3, focal_px: f64, center_px: DVec2) -> Camera {
    let cam_from_world = Pose::look_at(eye, DVec3::new(0.1, -0.2, 0.3), DVec3::new(0.2, 0.1, 1.0));
    Camera { cam_from_world, focal_px: DVec2::new(focal_px, focal_px * 1.1), center_px, size_px: [44, 29] }
}

/// Random splats around the origin. The standard deviation of means is `spread`; log-scales and opacity logits vary
/// around `log_scale` and `logit`.
pub(crate) fn splats(
    count: usize,
    spread: f32,
    log_scale: f32,
    logit: f32,
    sh_degree: u32,
    seed: u64,
) -> Splats {
    let mut random = Random::new(seed, Purpose::Test, 0, 0);
    let mut splats = Splats::with_capacity(count, sh_degree);
    for _ in 0..count {
        let mean = [0, 1, 2].map(|_| spread * random.normal());
        let quat = [0, 1, 2, 3].map(|_| random.normal());
        let log_scales = [0, 1, 2].map(|_| log_scale + 0.5 * random.normal());
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|_| 0.4 * random.normal()).collect();
        splats.push(mean, quat, log_scales, logit + random.normal(), &sh);
    }
    splats
}

fn cases() -> Vec<Case> {
    let center = DVec2::new(22.0, 14.5);
    let eye = DVec3::new(3.0, 2.0, 1.5);
    vec![
        Case {
            name: "rotated",
            camera: camera(eye, 40.0, center),
            splats: splats(14, 0.4, -1.6, 0.0, 3, 1),
            sh_degree: 3,
        },
        Case {
            name: "off-centre",
            camera: camera(-eye, 55.0, DVec2::new(9.0, 33.0)),
            splats: splats(14, 0.6, -1.5, 0.5, 3, 2),
            sh_degree: 2,
        },
        // Wide angle and large splats far outside the picture: slopes in the Jacobian are clamped.
        Case {
            name: "clamped",
            camera: camera(eye, 14.0, center),
            splats: splats(24, 2.2, -0.3, 0.0, 1, 3),
            sh_degree: 1,
        },
        // Pixels that become full, and alphas that are clamped.
        Case {
            name: "opaque",
            camera: camera(eye, 40.0, center),
            splats: splats(40, 0.5, -1.2, 4.0, 0, 4),
            sh_degree: 0,
        },
        // Small splats everywhere along the border of the picture, in several tiles.
        Case {
            name: "border",
            camera: camera(eye, 30.0, center),
            splats: splats(40, 1.3, -2.6, 1.0, 3, 5),
            sh_degree: 3,
        },
    ]
}

fn backend(case: &Case, isa: Isa, threads: usize) -> CpuBackend {
    let capacity = Capacity {
        splats: case.splats.len(),
        pairs: 10_000,
        size_px: case.camera.size_px,
        sh_degree: case.splats.sh_degree,
        channels: Channels::Geometry,
        training: true,
    };
    let mut backend = CpuBackend::with_isa(capacity, threads, isa);
    backend.load(&case.splats);
    backend.project(&case.camera, case.sh_degree);
    backend.bin();
    assert_eq!(backend.counts().dropped, 0);
    backend.rasterize(Channels::Geometry);
    backend
}

fn values(backend: &CpuBackend) -> Vec<Pixel> {
    let [width, height] = backend.image.size_px();
    (0..height)
        .flat_map(|y| (0..width).map(move |x| (x, y)))
        .map(|(x, y)| std::array::from_fn(|plane| f64::from(backend.image.value(plane, x, y))))
        .collect()
}

/// A random gradient for every channel of every pixel.
fn pixel_gradients(pixels: usize) -> Vec<Pixel> {
    let mut random = Random::new(9, Purpose::Test, 0, 0);
    (0..pixels).map(|_| std::array::from_fn(|_| f64::from(random.normal()))).collect()
}

fn backward(backend: &mut CpuBackend, gradients: &[Pixel]) -> Splats {
    let size = backend.image.size_px();
    backend.gradient.reshape(size.map(|side| side as u32), backend.image.planes());
    backend.gradient.rows_mut().fill(Row::ZERO);
    for (i, pixel) in gradients.iter().enumerate() {
        for (plane, value) in pixel.iter().enumerate() {
            backend.gradient.set_value(plane, i % size[0], i / size[0], *value as f32);
        }
    }
    backend.rasterize_backward();
    backend.project_backward();
    backend.gradients()
}

/// Every number of the splats, with the name of its parameter.
fn numbers(splats: &mut Splats) -> Vec<(&'static str, &mut f32)> {
    let mut all = Vec::new();
    all.extend(splats.means.iter_mut().flatten().map(|v| ("mean", v)));
    all.extend(splats.quats.iter_mut().flatten().map(|v| ("quat", v)));
    all.extend(splats.log_scales.iter_mut().flatten().map(|v| ("log_scale", v)));
    all.extend(splats.opacity_logits.iter_mut().map(|v| ("opacity_logit", v)));
    all.extend(splats.sh.iter_mut().map(|v| ("sh", v)));
    all
}

/// Central differences of the reference, in the order of [`numbers`].
fn differences(case: &Case, decisions: &Decisions, gradients: &[Pixel]) -> Vec<(&'static str, f64)> {
    let loss = |splats: &Splats| -> f64 {
        let picture = reference::render_as_decided(splats, &case.camera, case.sh_degree, decisions);
        picture.iter().zip(gradients).flat_map(|(p, g)| p.iter().zip(g).map(|(p, g)| p * g)).sum()
    };
    let mut splats = case.splats.clone();
    let count = numbers(&mut splats).len();
    (0..count)
        .map(|k| {
            let (name, value) = {
                let (name, value) = &mut numbers(&mut splats)[k];
                (*name, **value)
            };
            // Divides by the actual difference of the two f32 values, because rounding changes it.
            let step = 2e-4;
            let mut at = |v: f32| {
                *numbers(&mut splats)[k].1 = v;
                loss(&splats)
            };
            let (above, below) = (value + step, value - step);
            let slope = (at(above) - at(below)) / (f64::from(above) - f64::from(below));
            at(value);
            (name, slope)
        })
        .collect()
}

/// The largest relative error and its description. Errors are relative to the expected number, or to a hundredth of the
/// root mean square of its group if that is larger.
fn worst(analytic: &mut Splats, numeric: &[(&'static str, f64)]) -> (f64, String) {
    let rms = |group: &str| {
        let values: Vec<f64> =
            numeric.iter().filter(|(name, _)| *name == group).map(|(_, v)| v * v).collect();
        (values.iter().sum::<f64>() / values.len() as f64).sqrt()
    };
    let mut worst = (0.0, String::new());
    for (k, ((name, value), (_, expected))) in numbers(analytic).into_iter().zip(numeric).enumerate() {
        let error = (f64::from(*value) - expected).abs() / expected.abs().max(0.01 * rms(name)).max(1e-12);
        if error.is_nan() || error > worst.0 {
            worst = (error, format!("{name} (number {k}): {value} is not {expected}"));
        }
    }
    worst
}

#[test]
fn pictures_agree_with_the_reference() {
    for case in cases() {
        let (expected, _) = reference::render(&case.splats, &case.camera, case.sh_degree);
        for isa in Isa::available() {
            let got = values(&backend(&case, isa, 2));
            for (i, (got, expected)) in got.iter().zip(&expected).enumerate() {
                for (plane, (got, expected)) in got.iter().zip(expected).enumerate() {
                    let error = (got - expected).abs();
                    assert!(
                        error < 2e-4,
                        "{} {} pixel {i} plane {plane}: {got} is not {expected}",
                        case.name,
                        isa.name()
                    );
                }
            }
        }
    }
}

#[test]
fn gradients_agree_with_central_differences() {
    for case in cases() {
        let (picture, decisions) = reference::render(&case.splats, &case.camera, case.sh_degree);
        let gradients = pixel_gradients(picture.len());
        let numeric = differences(&case, &decisions, &gradients);
        for isa in Isa::available() {
            let mut analytic = backward(&mut backend(&case, isa, 2), &gradients);
            let (error, what) = worst(&mut analytic, &numeric);
            assert!(error < 1e-3, "{} {}: relative error {error:.2e} at {what}", case.name, isa.name());
        }
        // The comparison must notice one number of one splat that is wrong by 1 %.
        let mut wrong = backward(&mut backend(&case, Isa::best(), 1), &gradients);
        let largest =
            (0..wrong.len()).max_by(|a, b| wrong.means[*a][0].abs().total_cmp(&wrong.means[*b][0].abs()));
        wrong.means[largest.expect("a splat")][0] *= 1.01;
        assert!(worst(&mut wrong, &numeric).0 > 1e-3, "{}: a wrong gradient went unnoticed", case.name);
    }
}

#[test]
fn threads_do_not_change_a_bit() {
    for case in cases() {
        let gradients = pixel_gradients((case.camera.size_px[0] * case.camera.size_px[1]) as usize);
        let run = |threads| {
            let mut backend = backend(&case, Isa::best(), threads);
            let gradients = backward(&mut backend, &gradients);
            (backend.rendering(), gradients)
        };
        let one = run(1);
        assert_eq!(one, run(2), "{}", case.name);
        assert_eq!(one, run(8), "{}", case.name);
    }
}

#[test]
fn the_scale_loss_has_a_gradient_on_the_shortest_axis_of_visible_splats() {
    const WEIGHT: f32 = 3.0;
    for case in cases() {
        for isa in Isa::available() {
            let mut backend = backend(&case, isa, 2);
            backend.scale_weight = WEIGHT;
            let size = backend.image.size_px();
            let pulled = backward(&mut backend, &vec![[0.0; 8]; size[0] * size[1]]);
            let seen: Vec<usize> = (0..case.splats.len())
                .filter(|i| backend.projection.visible[i / 16] >> (i % 16) & 1 == 1)
                .collect();
            for i in 0..case.splats.len() {
                let log_scale = case.splats.log_scales[i];
                let shortest = log_scale.into_iter().fold(f32::INFINITY, f32::min);
                for axis in 0..3 {
                    let counts = seen.contains(&i) && log_scale[axis] == shortest;
                    let expected = if counts { WEIGHT * shortest.exp() / seen.len() as f32 } else { 0.0 };
                    let got = pulled.log_scales[i][axis];
                    assert!(
                        (got - expected).abs() <= 1e-5 * expected,
                        "{}: {got} is not {expected}",
                        case.name
                    );
                }
            }
        }
    }
}

#[test]
fn scores_agree_with_the_reference() {
    for case in cases() {
        let (_, decisions) = reference::render(&case.splats, &case.camera, case.sh_degree);
        let expected = reference::scores(&case.splats, &case.camera, &decisions);
        assert!(expected.iter().any(|(.., observed)| *observed), "{}", case.name);
        for isa in Isa::available() {
            let mut backend = backend(&case, isa, 2);
            backend.clear_scores();
            // Scored twice, as if there were two equal views.
            backend.score();
            backend.score();
            let scores = backend.scores();
            for (i, (weight, hits, observed)) in expected.iter().enumerate() {
                let error = (f64::from(scores.squared_weights[i]) - 2.0 * weight).abs();
                assert!(
                    error < 1e-3 * weight + 1e-4,
                    "{} splat {i}: {} is not {weight}",
                    case.name,
                    scores.squared_weights[i]
                );
                assert_eq!(scores.hits[i], 2.0 * *hits as f32, "{} splat {i}", case.name);
                assert_eq!(scores.observers[i], if *observed { 2.0 } else { 0.0 }, "{} splat {i}", case.name);
            }
        }
    }
}

#[test]
fn absolute_gradients_agree_with_central_differences() {
    for case in cases() {
        let (picture, decisions) = reference::render(&case.splats, &case.camera, case.sh_degree);
        let gradients = pixel_gradients(picture.len());
        let sums =
            reference::absolute_gradients(&case.splats, &case.camera, case.sh_degree, &decisions, &gradients);
        let half = DVec2::from(case.camera.size_px.map(f64::from)) / 2.0;
        for isa in Isa::available() {
            let mut backend = backend(&case, isa, 2);
            backward(&mut backend, &gradients);
            let shapes = backend.take_shapes();
            for (i, sum) in sums.iter().enumerate() {
                let (got, expected) = (f64::from(shapes.absolute_gradients[i]), (*sum * half).length());
                assert!(
                    (got - expected).abs() < 1e-3 * expected + 1e-6,
                    "{} splat {i}: {got} is not {expected}",
                    case.name
                );
                assert!(
                    got >= 0.999 * f64::from(shapes.screen_gradients[i]),
                    "the norm of a sum exceeds that of absolute values"
                );
            }
        }
    }
}
