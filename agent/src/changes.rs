//! Compares two models on the ground that an agent's cameras see: the model that training started from and the trained
//! model, or the trained model and the global model.

use cosurf_contract::Changes;
use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::Camera;
use cosurf_scene::metrics::psnr;

/// Longest side of the compared renderings, px. Smaller cameras are not enlarged.
const SIZE_PX: u32 = 160;
/// Limit on the number of compared cameras. If there are more, evenly spaced ones are compared.
const VIEWS_MAX: usize = 16;
/// Smallest alpha with which a pixel counts as showing a surface.
const ALPHA_MIN: f32 = 0.5;
/// A pixel's surface counts as moved if its depths in the two models differ by more than this share of the depth in
/// the first model. The limit lies above the median difference between two trainings of the same ground.
const DEPTH_MAX: f32 = 0.03;
/// Upper limit of the PSNR of one camera, dB, because the PSNR of equal renderings is infinite.
const PSNR_MAX: f64 = 99.0;

/// Renders both models from `cameras` and compares the renderings. Returns `None` if there are no cameras.
pub fn compare(before: &mut Renderer, after: &mut Renderer, cameras: &[Camera]) -> Option<Changes> {
    let views = cameras.len().min(VIEWS_MAX);
    let mut tally = Tally::default();
    for i in 0..views {
        let camera = &cameras[i * cameras.len() / views];
        let camera = camera.fitted(SIZE_PX);
        tally.add(&before.render(&camera), &after.render(&camera));
    }
    (views > 0).then(|| tally.changes(views))
}

/// Sums over the cameras compared so far.
#[derive(Default)]
struct Tally {
    psnr: f64,
    /// Relative difference of depth, at least 0, for each pixel that shows a surface in both models.
    differences: Vec<f32>,
    /// Number of pixels that show a surface only in the first model.
    gone: usize,
    /// Number of pixels that show a surface only in the second model.
    new: usize,
}

impl Tally {
    fn add(&mut self, before: &Rendering, after: &Rendering) {
        let clamped = |of: &Rendering| of.rgb.iter().map(|value| value.clamp(0.0, 1.0)).collect::<Vec<_>>();
        self.psnr += psnr(&clamped(before), &clamped(after)).min(PSNR_MAX);
        let depth =
            |of: &Rendering, i: usize| (of.alpha[i] >= ALPHA_MIN && of.depth[i] > 0.0).then_some(of.depth[i]);
        for i in 0..before.depth.len() {
            match (depth(before, i), depth(after, i)) {
                (Some(before), Some(after)) => self.differences.push((after / before - 1.0).abs()),
                (Some(_), None) => self.gone += 1,
                (None, Some(_)) => self.new += 1,
                (None, None) => {}
            }
        }
    }

    fn changes(mut self, views: usize) -> Changes {
        let both = self.differences.len();
        let moved = self.differences.iter().filter(|difference| **difference > DEPTH_MAX).count();
        let shown = (both + self.gone + self.new).max(1) as f64;
        let median = (both > 0).then(|| {
            let (_, median, _) = self.differences.select_nth_unstable_by(both / 2, f32::total_cmp);
            f64::from(*median)
        });
        Changes {
            views,
            psnr: self.psnr / views as f64,
            depth: median,
            moved: moved as f64 / shown,
            gone: self.gone as f64 / shown,
            new: self.new as f64 / shown,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Pose, Splats};
    use glam::{DVec2, DVec3};

    use super::*;

    fn above() -> Camera {
        Camera {
            cam_from_world: Pose::look_at(DVec3::Z * 10.0, DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(40.0),
            center_px: DVec2::new(24.0, 16.0),
            size_px: [48, 32],
        }
    }

    /// A model of horizontal ground from x = -8 to x = `east`, at z = 0 where x < 0 and at z = `height` elsewhere.
    fn ground(east: f32, height: f32) -> Renderer {
        let mut splats = Splats::with_capacity(0, 0);
        for i in 0..((east + 8.0) * 2.0) as i32 {
            for j in -12..12 {
                let (x, y) = (-8.0 + 0.5 * i as f32, 0.5 * j as f32);
                let z = if x < 0.0 { 0.0 } else { height };
                splats.push([x, y, z], [1.0, 0.0, 0.0, 0.0], [-1.2, -1.2, -5.0], 6.0, &[0.5; 3]);
            }
        }
        Renderer::new(&splats, 1)
    }

    #[test]
    fn equal_models_have_no_changes() {
        let changes = compare(&mut ground(8.0, 0.0), &mut ground(8.0, 0.0), &[above()]).unwrap();
        assert_eq!((changes.views, changes.moved, changes.gone, changes.new), (1, 0.0, 0.0, 0.0));
        assert!(changes.psnr > 90.0 && changes.depth == Some(0.0), "{changes:?}");
        assert_eq!(compare(&mut ground(8.0, 0.0), &mut ground(8.0, 0.0), &[]), None);
    }

    #[test]
    fn moved_gone_and_new_ground_are_counted() {
        let risen = compare(&mut ground(8.0, 0.0), &mut ground(8.0, 1.0), &[above()]).unwrap();
        assert!((risen.moved - 0.5).abs() < 0.1 && risen.gone + risen.new < 0.02, "{risen:?}");
        let gone = compare(&mut ground(8.0, 0.0), &mut ground(0.0, 0.0), &[above()]).unwrap();
        assert!((gone.gone - 0.5).abs() < 0.1 && gone.new == 0.0, "{gone:?}");
        let new = compare(&mut ground(0.0, 0.0), &mut ground(8.0, 0.0), &[above()]).unwrap();
        assert!((new.new - 0.5).abs() < 0.1 && new.gone == 0.0, "{new:?}");
    }
}
