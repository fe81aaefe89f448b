//! Exposure of each photograph (PGSR, §"Exposure compensation"): cameras that choose their own exposure
//! show the same wall brighter here and darker there. A gain and an offset per view take that off the
//! model's colours; only L1 sees them.

use crate::backend::{Exposure, PhotometricLoss};

/// Adam's rate and decays (PGSR).
const RATE: f64 = 1e-3;
const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.99;
const EPSILON: f64 = 1e-15;

/// A view that looks less like its photograph than this says nothing of exposure yet (PGSR: 1 - SSIM < 0.5). It
/// is the SSIM of the view's visit before that decides, so that one sweep over the picture suffices.
const SSIM_MIN: f32 = 0.5;

/// Numbers that a checkpoint keeps of a view.
const NUMBERS: usize = 8;

/// Exposures of all views, with their optimiser.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Exposures {
    /// Learns faster by this factor, as the other rates do in a short training.
    haste: f64,
    views: Vec<View>,
}

/// Exposure and moments of a view: of the gain's logarithm, and of the offset.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct View {
    values: [f32; 2],
    first: [f32; 2],
    second: [f32; 2],
    steps: f32,
    /// At the last visit.
    ssim: f32,
}

impl Exposures {
    /// Nothing is known yet.
    pub(crate) fn new(views: usize, haste: f64) -> Self {
        Self { haste, views: vec![View::default(); views] }
    }

    /// As the view's photograph was exposed; colours as they are while the view does not look like it.
    pub(crate) fn of(&self, view: usize) -> Exposure {
        let View { values: [log_gain, offset], ssim, .. } = self.views[view];
        if ssim > SSIM_MIN { Exposure { gain: log_gain.exp(), offset } } else { Exposure::default() }
    }

    /// Learns from what a step found of a view; where it is too early to `adapt`, only how it looks.
    pub(crate) fn learn(&mut self, view: usize, loss: &PhotometricLoss, adapt: bool) {
        let gain = f64::from(self.of(view).gain);
        let view = &mut self.views[view];
        if adapt && view.ssim > SSIM_MIN {
            view.adam([loss.by_gain * gain, loss.by_offset], RATE * self.haste);
        }
        view.ssim = loss.ssim as f32;
    }

    /// Visits all numbers in a fixed order.
    pub(crate) fn export<E>(&self, mut visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        self.views.iter().try_for_each(|view| visit(&view.to_numbers()))
    }

    /// Restores what [`Self::export`] visited.
    pub(crate) fn import<E>(&mut self, mut fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E> {
        self.views.iter_mut().try_for_each(|view| {
            let mut numbers = [0.0; NUMBERS];
            fill(&mut numbers)?;
            *view = View::from_numbers(numbers);
            Ok(())
        })
    }
}

impl View {
    fn adam(&mut self, gradients: [f64; 2], rate: f64) {
        self.steps += 1.0;
        let steps = f64::from(self.steps);
        for (i, gradient) in gradients.into_iter().enumerate() {
            let first = BETA_1 * f64::from(self.first[i]) + (1.0 - BETA_1) * gradient;
            let second = BETA_2 * f64::from(self.second[i]) + (1.0 - BETA_2) * gradient * gradient;
            let mean = first / (1.0 - BETA_1.powf(steps));
            let spread = (second / (1.0 - BETA_2.powf(steps))).sqrt();
            (self.first[i], self.second[i]) = (first as f32, second as f32);
            self.values[i] -= (rate * mean / (spread + EPSILON)) as f32;
        }
    }

    fn to_numbers(self) -> [f32; NUMBERS] {
        let Self { values, first, second, steps, ssim } = self;
        [values[0], values[1], first[0], first[1], second[0], second[1], steps, ssim]
    }

    fn from_numbers(numbers: [f32; NUMBERS]) -> Self {
        let [a, b, c, d, e, f, steps, ssim] = numbers;
        Self { values: [a, b], first: [c, d], second: [e, f], steps, ssim }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// L1 of a photograph taken with gain 1.3 and offset -0.05 of colours 0, 0.1 … 1, and its slopes.
    fn loss(exposure: Exposure, ssim: f64) -> PhotometricLoss {
        let mut loss = PhotometricLoss { ssim, ..PhotometricLoss::default() };
        for color in (0..=10).map(|i| f64::from(i) / 10.0) {
            let shown = f64::from(exposure.gain) * color + f64::from(exposure.offset);
            let sign = (shown - (1.3 * color - 0.05)).signum();
            loss.by_gain += sign * color / 11.0;
            loss.by_offset += sign / 11.0;
        }
        loss
    }

    #[test]
    fn an_exposure_is_found() {
        let mut exposures = Exposures::new(2, 1.0);
        for _ in 0..1500 {
            let loss = loss(exposures.of(1), 0.9);
            exposures.learn(1, &loss, true);
        }
        let found = exposures.of(1);
        assert!((found.gain - 1.3).abs() < 0.01 && (found.offset + 0.05).abs() < 0.01, "{found:?}");
        assert_eq!(exposures.of(0), Exposure::default(), "other views keep theirs");
    }

    #[test]
    fn views_that_look_like_nothing_say_nothing() {
        let mut exposures = Exposures::new(1, 1.0);
        for _ in 0..100 {
            exposures.learn(0, &loss(exposures.of(0), 0.4), true);
            assert_eq!(exposures.of(0), Exposure::default());
        }
        exposures.learn(0, &loss(Exposure::default(), 0.6), true);
        exposures.learn(0, &loss(Exposure::default(), 0.6), false);
        assert_eq!(exposures.of(0), Exposure::default(), "nothing was learnt too early");
        exposures.learn(0, &loss(Exposure::default(), 0.6), true);
        assert_ne!(exposures.of(0), Exposure::default());
    }

    #[test]
    fn a_checkpoint_keeps_everything() {
        let mut exposures = Exposures::new(3, 1.0);
        (0..9).for_each(|i| exposures.learn(i % 3, &loss(exposures.of(i % 3), 0.9), true));
        let mut numbers = Vec::new();
        let visited: Result<(), ()> = exposures.export(|part| {
            numbers.extend_from_slice(part);
            Ok(())
        });
        let (mut restored, mut rest) = (Exposures::new(3, 1.0), numbers.as_slice());
        let filled: Result<(), ()> = restored.import(|part| {
            let (mine, others) = rest.split_at(part.len());
            part.copy_from_slice(mine);
            rest = others;
            Ok(())
        });
        assert_eq!((visited, filled), (Ok(()), Ok(())));
        assert_eq!(restored, exposures);
    }
}
