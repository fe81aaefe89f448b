//! Draws the training curve: a mean PSNR for each of a number of stretches of the training.

use cosurf_contract::Curve;

/// Number of points of a training.
const POINTS: u32 = 64;

/// A curve that grows while a training runs.
pub(super) struct GrowingCurve {
    curve: Curve,
    /// Number of steps from one point to the next.
    every: u32,
    /// Sum of the PSNR of the steps since the last point, dB, and their number.
    since: (f64, u32),
}

impl GrowingCurve {
    /// Goes on with a curve of earlier steps, to a training of `steps` steps.
    pub(super) fn on(curve: Curve, steps: u32) -> Self {
        Self { curve, every: steps.div_ceil(POINTS).max(1), since: (0.0, 0) }
    }

    /// Adds a step with the PSNR of its picture, dB.
    pub(super) fn step(&mut self, step: u32, psnr: f64) {
        self.since = (self.since.0 + psnr, self.since.1 + 1);
        if step.is_multiple_of(self.every) {
            self.curve.push(step, (self.since.0 / f64::from(self.since.1)) as f32);
            self.since = (0.0, 0);
        }
    }

    pub(super) fn curve(&self) -> &Curve {
        &self.curve
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_goes_on_where_the_checkpoint_ended() {
        let mut first = GrowingCurve::on(Curve::default(), 640);
        (1..=100).for_each(|step| first.step(step, f64::from(step)));
        assert_eq!(first.curve().points()[..2], [[10.0, 5.5], [20.0, 15.5]]);
        let mut second = GrowingCurve::on(first.curve().clone(), 640);
        (101..=640).for_each(|step| second.step(step, f64::from(step)));
        let mut whole = GrowingCurve::on(Curve::default(), 640);
        (1..=640).for_each(|step| whole.step(step, f64::from(step)));
        assert_eq!((second.curve(), second.curve().points().len()), (whole.curve(), 64));
    }
}
