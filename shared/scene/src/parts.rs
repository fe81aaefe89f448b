//! Hands the splats of a file to a caller in parts of limited size, moved into the caller's frame. Splats that cannot be
//! rendered are left out and counted.
//!
//! What it knows nothing about: file formats.

use glam::DVec3;

use crate::{LocalFrame, Splats};

/// Largest number of values of a splat's spherical harmonics.
const SH_MAX: usize = 48;
/// Logit for an infinite opacity: converters write infinity for an opacity of exactly 0 or 1.
const OPACITY_LOGIT_MOST: f32 = 16.0;

/// A splat as a file has it, with any values.
pub(crate) struct Record {
    pub(crate) mean: [f32; 3],
    pub(crate) quat: [f32; 4],
    pub(crate) log_scale: [f32; 3],
    pub(crate) opacity_logit: f32,
    /// `[coefficient, rgb]`; the values beyond the degree of the file are not used.
    pub(crate) sh: [f32; SH_MAX],
}

impl Record {
    /// All values are 0.
    pub(crate) const ZERO: Self =
        Self { mean: [0.0; 3], quat: [0.0; 4], log_scale: [0.0; 3], opacity_logit: 0.0, sh: [0.0; SH_MAX] };

    /// Appends the splat as it is.
    pub(crate) fn push_to(&self, splats: &mut Splats) {
        let sh = &self.sh[..splats.sh_stride()];
        splats.push(self.mean, self.quat, self.log_scale, self.opacity_logit, sh);
    }
}

/// Collects splats, and calls `visit` whenever there are `most`.
pub(crate) struct Parts<'a> {
    splats: Splats,
    most: usize,
    files: LocalFrame,
    frame: &'a LocalFrame,
    visit: &'a mut dyn FnMut(&Splats),
    unusable: usize,
}

impl<'a> Parts<'a> {
    /// For parts in `frame`. `most` is at least 1.
    pub(crate) fn new(frame: &'a LocalFrame, most: usize, visit: &'a mut dyn FnMut(&Splats)) -> Self {
        Self { splats: Splats::default(), most, files: LocalFrame::WORLD, frame, visit, unusable: 0 }
    }

    /// Tells the degree of the splats to come, their number, which has been checked against the file's length, and the world
    /// position that their positions are relative to.
    pub(crate) fn begin(&mut self, sh_degree: u32, count: usize, origin: DVec3) {
        self.splats = Splats::with_capacity(count.min(self.most), sh_degree);
        self.files = LocalFrame::at(origin);
    }

    /// Takes the next splat.
    pub(crate) fn add(&mut self, record: &Record) {
        record.push_to(&mut self.splats);
        let last = self.splats.len() - 1;
        let logit = &mut self.splats.opacity_logits[last];
        if logit.is_infinite() {
            *logit = OPACITY_LOGIT_MOST.copysign(*logit);
        }
        if self.splats.find_bad_value_of(last).is_some() {
            self.splats.pop();
            self.unusable += 1;
        }
        if self.splats.len() >= self.most {
            self.hand_over();
        }
    }

    fn hand_over(&mut self) {
        self.files.move_splats(&mut self.splats, self.frame);
        (self.visit)(&self.splats);
        self.splats.clear();
    }

    /// Hands over the last part. Returns the number of splats that were left out.
    pub(crate) fn end(mut self) -> usize {
        if !self.splats.is_empty() {
            self.hand_over();
        }
        self.unusable
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unusable_splats_are_left_out_and_infinite_opacities_bounded() {
        let record = |x: f32, opacity_logit: f32| Record {
            mean: [x, 0.0, 0.0],
            quat: [1.0, 0.0, 0.0, 0.0],
            opacity_logit,
            ..Record::ZERO
        };
        let mut sizes = Vec::new();
        let mut all = Splats::default();
        let mut visit = |part: &Splats| {
            sizes.push(part.len());
            all.extend(part);
        };
        let frame = LocalFrame::at(DVec3::X * 1000.0);
        let mut parts = Parts::new(&frame, 2, &mut visit);
        parts.begin(0, 5, DVec3::X * 1001.0);
        for (x, logit) in
            [(1.0, 0.5), (f32::NAN, 0.0), (2.0, f32::INFINITY), (3.0, f32::NAN), (4.0, f32::NEG_INFINITY)]
        {
            parts.add(&record(x, logit));
        }
        assert_eq!(parts.end(), 2);
        assert_eq!(sizes, [2, 1]);
        assert_eq!(all.means, [[2.0, 0.0, 0.0], [3.0, 0.0, 0.0], [5.0, 0.0, 0.0]]);
        assert_eq!(all.opacity_logits, [0.5, OPACITY_LOGIT_MOST, -OPACITY_LOGIT_MOST]);
    }
}
