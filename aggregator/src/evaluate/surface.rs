//! Compares a model's surface with the true surface, pixel by pixel from a camera: depth, normals and coverage.
//!
//! What it knows nothing about: where models and true surfaces come from.

use cosurf_engine::Rendering;
use cosurf_scene::{Camera, Cast};
use glam::{DVec2, Vec3};
use serde::{Deserialize, Serialize};

/// A model has a surface in a pixel if its accumulated opacity (alpha) there is above this value.
const ALPHA_MIN: f32 = 0.5;
/// Blended normals shorter than this have no reliable direction.
const NORMAL_LENGTH_MIN: f32 = 1e-3;

/// How much a model's surface differs from the true one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SurfaceQuality {
    /// Share, 0..=1, of the pixels with a true surface in which the model has a surface too (the *covered* pixels).
    /// The errors below count only covered pixels, so they mean little if this share is low.
    pub coverage: f64,
    /// Relative error of depth, percent: `100 |z - z*| / z*`, where `z` is the model's depth along the optical axis
    /// and `z*` the true one. Absent if no pixel is covered.
    pub depth_error_percent: Option<Spread>,
    /// Angle between the blended normal of a pixel and the true normal, degrees. The true normal is the mean over
    /// the pixel's area, see [`cosurf_scene::Caster::cast_areas`]. Absent if no covered pixel has a blended normal
    /// with a reliable direction.
    pub normal_error_deg: Option<Spread>,
    /// Angle between the normal of depth of a pixel and the true normal (the mean over the pixel's area), degrees.
    /// The normal of depth is computed from the depths of the four neighbouring pixels. This error matters to
    /// meshes, which are fused from depths. Absent unless a covered pixel has four neighbours with a surface.
    #[serde(default)]
    pub depth_normal_error_deg: Option<Spread>,
}

/// Median and mean of the errors of many pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Half of the errors are smaller.
    pub median: f64,
    /// The mean; a few large errors can raise it much.
    pub mean: f64,
}

impl Spread {
    fn of(errors: &[f32]) -> Option<Self> {
        let mut known: Vec<f32> = errors.iter().copied().filter(|error| !error.is_nan()).collect();
        let mean = known.iter().map(|&error| f64::from(error)).sum::<f64>() / known.len() as f64;
        let middle = known.len() / 2;
        let has_any = !known.is_empty();
        has_any.then(|| Self {
            median: f64::from(*known.select_nth_unstable_by(middle, f32::total_cmp).1),
            mean,
        })
    }

    fn mean(of: impl Iterator<Item = Self>) -> Option<Self> {
        let all: Vec<Self> = of.collect();
        let mean = |value: fn(&Self) -> f64| all.iter().map(value).sum::<f64>() / all.len() as f64;
        (!all.is_empty())
            .then(|| Self { median: mean(|spread| spread.median), mean: mean(|spread| spread.mean) })
    }
}

impl SurfaceQuality {
    /// Compares a rendering with the true surface as the same `camera` sees it; `None` if the camera sees no true
    /// surface.
    pub fn of(rendering: &Rendering, camera: &Camera, truth: &Cast) -> Option<Self> {
        let seen: Vec<usize> = (0..truth.depth.len()).filter(|&i| truth.depth[i] > 0.0).collect();
        let covered = seen.iter().filter(|&&i| has_surface(rendering, i)).count();
        (!seen.is_empty()).then(|| Self {
            coverage: covered as f64 / seen.len() as f64,
            depth_error_percent: Spread::of(&depth_errors_percent(rendering, truth)),
            normal_error_deg: Spread::of(&normal_errors_deg(rendering, truth)),
            depth_normal_error_deg: Spread::of(&depth_normal_errors_deg(rendering, camera, truth)),
        })
    }

    /// The mean of each figure over the views that have it; `None` without views.
    pub(crate) fn mean(of: &[Self]) -> Option<Self> {
        let coverage = of.iter().map(|quality| quality.coverage).sum::<f64>() / of.len() as f64;
        (!of.is_empty()).then(|| Self {
            coverage,
            depth_error_percent: Spread::mean(of.iter().filter_map(|quality| quality.depth_error_percent)),
            normal_error_deg: Spread::mean(of.iter().filter_map(|quality| quality.normal_error_deg)),
            depth_normal_error_deg: Spread::mean(
                of.iter().filter_map(|quality| quality.depth_normal_error_deg),
            ),
        })
    }
}

/// Whether the model has a surface in pixel `i`.
fn has_surface(rendering: &Rendering, i: usize) -> bool {
    let depth = rendering.depth[i];
    rendering.alpha[i] > ALPHA_MIN && depth > 0.0 && depth.is_finite()
}

/// Relative error of depth of each pixel, percent, as in [`SurfaceQuality`]. NaN where the model or the truth has
/// no surface.
pub(crate) fn depth_errors_percent(rendering: &Rendering, truth: &Cast) -> Vec<f32> {
    errors(rendering, truth, |i| 100.0 * (rendering.depth[i] - truth.depth[i]).abs() / truth.depth[i])
}

/// Angle between the blended normal and the true normal of each pixel, degrees. NaN where the model or the truth
/// has no surface, and where the blended normal is too short to have a direction.
pub(crate) fn normal_errors_deg(rendering: &Rendering, truth: &Cast) -> Vec<f32> {
    let normals = rendering.normal.as_chunks::<3>().0;
    errors(rendering, truth, |i| {
        let normal = Vec3::from(normals[i]);
        let has_direction = normal.length() > NORMAL_LENGTH_MIN;
        if has_direction { angle_deg(normal, truth.normals[i].into()) } else { f32::NAN }
    })
}

/// Angle between the normal of depth and the true normal of each pixel, degrees. NaN where the model or the truth
/// has no surface, or where the model has none in one of the four neighbouring pixels.
fn depth_normal_errors_deg(rendering: &Rendering, camera: &Camera, truth: &Cast) -> Vec<f32> {
    let [width, height] = rendering.size_px.map(|side| side as usize);
    let point = |i: usize| {
        let ray = camera.ray(DVec2::new((i % width) as f64, (i / width) as f64) + 0.5);
        has_surface(rendering, i).then(|| ray * f64::from(rendering.depth[i]))
    };
    let normal = |i: usize| {
        let inside = (1..width - 1).contains(&(i % width)) && (1..height - 1).contains(&(i / width));
        let way = |to: usize, from: usize| Some(point(to)? - point(from)?);
        // The y axis of the picture points down. In this order, the cross product therefore faces the camera.
        inside.then(|| Some(way(i + 1, i - 1)?.cross(way(i - width, i + width)?).as_vec3()))?
    };
    errors(rendering, truth, |i| {
        normal(i).map_or(f32::NAN, |normal| angle_deg(normal, truth.normals[i].into()))
    })
}

/// The angle between two vectors, degrees. It uses sine and cosine, because the arc cosine loses small angles to
/// rounding.
fn angle_deg(a: Vec3, b: Vec3) -> f32 {
    a.cross(b).length().atan2(a.dot(b)).to_degrees()
}

fn errors(rendering: &Rendering, truth: &Cast, error: impl Fn(usize) -> f32) -> Vec<f32> {
    assert_eq!(rendering.size_px, truth.size_px, "rendering and truth differ in size");
    let both = |i: usize| truth.depth[i] > 0.0 && has_surface(rendering, i);
    (0..truth.depth.len()).map(|i| if both(i) { error(i) } else { f32::NAN }).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Pose;
    use glam::{DVec3, Quat};

    use super::*;

    /// A wall at depth 20 that faces the camera. The last of the ten pixels is a hole.
    fn truth() -> Cast {
        let mut depth = vec![20.0; 10];
        let mut normals = vec![[0.0, 0.0, -1.0]; 10];
        (depth[9], normals[9]) = (0.0, [0.0; 3]);
        Cast { size_px: [5, 2], depth, normals }
    }

    /// A model of the wall without the hole; its blended normals are shorter than 1.
    fn model() -> Rendering {
        Rendering {
            size_px: [5, 2],
            rgb: vec![0.0; 30],
            alpha: vec![0.9; 10],
            depth: vec![20.0; 10],
            normal: [0.0, 0.0, -0.8].repeat(10),
        }
    }

    fn camera(size_px: [u32; 2]) -> Camera {
        let center_px = DVec2::new(f64::from(size_px[0]), f64::from(size_px[1])) / 2.0;
        Camera {
            cam_from_world: Pose::look_at(DVec3::ZERO, DVec3::Z, DVec3::Y),
            focal_px: DVec2::splat(5.0),
            center_px,
            size_px,
        }
    }

    fn judged(model: &Rendering) -> Option<SurfaceQuality> {
        SurfaceQuality::of(model, &camera([5, 2]), &truth())
    }

    #[test]
    fn the_true_surface_has_no_error() {
        let quality = judged(&model()).unwrap();
        let none = Some(Spread { median: 0.0, mean: 0.0 });
        let expected = SurfaceQuality {
            coverage: 1.0,
            depth_error_percent: none,
            normal_error_deg: none,
            // The picture has only two rows, so no pixel has neighbours on all four sides.
            depth_normal_error_deg: None,
        };
        assert_eq!(quality, expected);
    }

    #[test]
    fn the_normals_of_depth_are_those_of_the_slope() {
        let camera = camera([6, 5]);
        let normal = Vec3::new(0.3, -0.5, -0.8).normalize();
        let place = |i: usize| DVec2::new((i % 6) as f64, (i / 6) as f64) + 0.5;
        let depth: Vec<f32> = (0..30).map(|i| 20.0 / -normal.dot(camera.ray(place(i)).as_vec3())).collect();
        let slope = Rendering {
            size_px: [6, 5],
            rgb: vec![0.0; 90],
            alpha: vec![0.9; 30],
            depth: depth.clone(),
            normal: vec![0.0; 90],
        };
        for degrees in [0.0_f32, 7.5, 90.0] {
            let turned =
                Quat::from_axis_angle(normal.any_orthonormal_vector(), degrees.to_radians()) * normal;
            let truth = Cast { size_px: [6, 5], depth: depth.clone(), normals: vec![turned.to_array(); 30] };
            let quality = SurfaceQuality::of(&slope, &camera, &truth).unwrap();
            let error = quality.depth_normal_error_deg.unwrap();
            assert!((error.median - f64::from(degrees)).abs() < 1e-3, "{error:?} is not {degrees}");
            assert_eq!(quality.normal_error_deg, None);
        }
    }

    #[test]
    fn a_shifted_depth_is_noticed() {
        let mut shifted = model();
        shifted.depth.iter_mut().for_each(|z| *z += 0.5);
        let error = |model: &Rendering| judged(model).unwrap().depth_error_percent.unwrap();
        assert_eq!(error(&shifted), Spread { median: 2.5, mean: 2.5 });
        // One pixel with a large error changes the mean but not the median. The pixel of the hole does not count.
        let mut spoiled = model();
        (spoiled.depth[3], spoiled.depth[9]) = (200.0, 1.0);
        assert_eq!(error(&spoiled), Spread { median: 0.0, mean: 100.0 });
    }

    #[test]
    fn a_rotated_normal_gives_its_angle() {
        for degrees in [0.01_f32, 7.5, 90.0, 170.0] {
            let mut rotated = model();
            let (sine, cosine) = degrees.to_radians().sin_cos();
            rotated.normal = [0.6 * sine, 0.0, -0.6 * cosine].repeat(10);
            let error = judged(&rotated).unwrap().normal_error_deg.unwrap();
            let off = (error.median - f64::from(degrees)).abs().max((error.mean - f64::from(degrees)).abs());
            assert!(off < 1e-3, "{error:?} is not {degrees}");
        }
    }

    #[test]
    fn uncovered_pixels_lower_the_coverage_and_have_no_error() {
        let mut thin = model();
        thin.alpha[..3].fill(0.5);
        thin.depth[..2].fill(99.0);
        thin.depth[4] = 0.0;
        let quality = judged(&thin).unwrap();
        assert!((quality.coverage - 5.0 / 9.0).abs() < 1e-12, "{quality:?}");
        assert_eq!(quality.depth_error_percent, Some(Spread { median: 0.0, mean: 0.0 }));
        thin.alpha.fill(0.0);
        let nothing = SurfaceQuality {
            coverage: 0.0,
            depth_error_percent: None,
            normal_error_deg: None,
            depth_normal_error_deg: None,
        };
        assert_eq!(judged(&thin), Some(nothing));
        let empty = Cast { depth: vec![0.0; 10], ..truth() };
        assert_eq!(SurfaceQuality::of(&model(), &camera([5, 2]), &empty), None);
        // The view without any covered pixel counts for the mean coverage. It has no error, so it does not count
        // for the mean error.
        let mean = SurfaceQuality::mean(&[quality, nothing]).unwrap();
        assert!((mean.coverage - 2.5 / 9.0).abs() < 1e-12);
        assert_eq!(mean.depth_error_percent, quality.depth_error_percent);
        assert_eq!(SurfaceQuality::mean(&[]), None);
    }
}
