//! Exposure of each photograph (PGSR, §"Exposure compensation"). Cameras with automatic exposure show the same wall
//! with different brightness. Each view therefore has its own gain and offset, so that the differences do not enter the
//! splats' colours. Only the L1 loss uses gain and offset.

use crate::backend::{Exposure, PhotometricLoss};

/// Learning rate of exposures (PGSR).
const RATE: f64 = 1e-3;
/// Decays of Adam's first and second moment (PGSR), and the term that keeps its division finite.
const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.99;
const EPSILON: f64 = 1e-15;

/// SSIM above which the exposure of a view is trained and used (PGSR: 1 - SSIM < 0.5). The SSIM of the view's previous
/// step decides, so that the losses need only one sweep over the picture.
const SSIM_MIN: f32 = 0.5;

/// Number of values of one view in a checkpoint.
const NUMBERS: usize = 8;

/// Exposures of all views, with their optimiser.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Exposures {
    /// Factor on the learning rate; above 1 in short runs.
    haste: f64,
    views: Vec<View>,
}

/// Exposure of a view, with Adam's moments. Each array holds a number for the logarithm of the gain, then one for the
/// offset.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct View {
    values: [f32; 2],
    first: [f32; 2],
    second: [f32; 2],
    steps: f32,
    /// SSIM at the view's last step.
    ssim: f32,
}

impl Exposures {
    /// Default exposures of `views` views. `haste` is a factor on the learning rate.
    pub(crate) fn new(views: usize, haste: f64) -> Self {
        Self { haste, views: vec![View::default(); views] }
    }

    /// Exposure of a view's photograph. It is the default, which changes no colour, unless the SSIM of the view's last
    /// step exceeds [`SSIM_MIN`].
    pub(crate) fn of(&self, view: usize) -> Exposure {
        let View { values: [log_gain, offset], ssim, .. } = self.views[view];
        if ssim > SSIM_MIN { Exposure { gain: libm::expf(log_gain), offset } } else { Exposure::default() }
    }

    /// Stores the SSIM of a view's step. Before that, trains the exposure of the view if `adapt` is true and the SSIM
    /// of its previous step is above [`SSIM_MIN`].
    pub(crate) fn update(&mut self, view: usize, loss: &PhotometricLoss, adapt: bool) {
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
            let mean = first / (1.0 - libm::pow(BETA_1, steps));
            let spread = (second / (1.0 - libm::pow(BETA_2, steps))).sqrt();
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

    /// A loss with the derivatives of L1 by gain and offset. The rendering has the colours 0, 0.1 … 1; the photograph
    /// shows them with gain 1.3 and offset -0.05.
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
    fn exposure_converges_to_that_of_the_photograph() {
        let mut exposures = Exposures::new(2, 1.0);
        for _ in 0..1500 {
            let loss = loss(exposures.of(1), 0.9);
            exposures.update(1, &loss, true);
        }
        let found = exposures.of(1);
        assert!((found.gain - 1.3).abs() < 0.01 && (found.offset + 0.05).abs() < 0.01, "{found:?}");
        assert_eq!(exposures.of(0), Exposure::default(), "other views keep theirs");
    }

    #[test]
    fn views_unlike_their_photograph_do_not_train_exposure() {
        let mut exposures = Exposures::new(1, 1.0);
        for _ in 0..100 {
            exposures.update(0, &loss(exposures.of(0), 0.4), true);
            assert_eq!(exposures.of(0), Exposure::default());
        }
        exposures.update(0, &loss(Exposure::default(), 0.6), true);
        exposures.update(0, &loss(Exposure::default(), 0.6), false);
        assert_eq!(exposures.of(0), Exposure::default(), "no exposure was trained too early");
        exposures.update(0, &loss(Exposure::default(), 0.6), true);
        assert_ne!(exposures.of(0), Exposure::default());
    }

    #[test]
    fn a_checkpoint_keeps_all_exposures() {
        let mut exposures = Exposures::new(3, 1.0);
        (0..9).for_each(|i| exposures.update(i % 3, &loss(exposures.of(i % 3), 0.9), true));
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
