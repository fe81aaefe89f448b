//! A training curve: the PSNR of the training pictures over steps.

use serde::{Deserialize, Serialize};

/// Largest number of points. When a curve would become longer, every other point is dropped. A checkpoint holds as many in
/// its first line.
const POINTS_MAX: usize = 100;

/// Points `[step, PSNR in dB]` in the order of steps. Each PSNR is a mean over the training pictures since the point before.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Curve(Vec<[f32; 2]>);

impl Curve {
    /// Adds a point, unless the PSNR is not finite. A training that goes on from an earlier step does steps again, so the
    /// points from `step` on are dropped first.
    pub fn push(&mut self, step: u32, psnr: f32) {
        let step = step as f32;
        while self.0.last().is_some_and(|last| last[0] >= step) {
            self.0.pop();
        }
        if self.0.len() >= POINTS_MAX {
            let mut index = 0;
            self.0.retain(|_| {
                index += 1;
                index % 2 == 0
            });
        }
        if psnr.is_finite() {
            self.0.push([step, psnr]);
        }
    }

    /// The points.
    pub fn points(&self) -> &[[f32; 2]] {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_that_are_done_again_take_the_place_of_the_earlier_ones() {
        let mut curve = Curve::default();
        [100, 200, 300, 250].into_iter().for_each(|step| curve.push(step, 20.0));
        curve.push(280, f32::NAN);
        let steps: Vec<f32> = curve.points().iter().map(|point| point[0]).collect();
        assert_eq!(steps, [100.0, 200.0, 250.0]);
    }

    #[test]
    fn a_long_curve_stays_short_and_keeps_its_end() {
        let mut curve = Curve::default();
        (1..=5000).for_each(|step| curve.push(step, 20.0));
        assert!((POINTS_MAX / 2..=POINTS_MAX).contains(&curve.points().len()), "{}", curve.points().len());
        assert_eq!(curve.points().last().map(|point| point[0]), Some(5000.0));
        assert!(curve.points().is_sorted_by(|a, b| a[0] < b[0]));
    }
}
