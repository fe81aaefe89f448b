//! What the cameras of all models observed, in a file. For some place, only the observations of the models with cameras
//! that may see it are read, so the memory does not grow with the site.

use cosurf_engine::compress::{PROVEN_MIN, shown_min};
use cosurf_engine::{Observations, Observers, Reach, Trust};
use cosurf_link::Model;
use cosurf_scene::{Camera, Frustum};
use glam::DVec3;
use tracing::info_span;

use super::computer::Computer;
use super::error::MergeError;
use super::locals::Surveyed;
use crate::scratch::{Record, Records, Scratch};

/// The observations of all models.
#[derive(Debug)]
pub(super) struct Observed<'a> {
    cameras: &'a [Vec<Camera>],
    records: Records,
    models: Vec<Its>,
    /// Share of its picture in which a camera that is believed shows a surface.
    shown_min: f64,
    /// True to judge by the cameras alone.
    as_announced: bool,
}

/// What stays in memory of the observations of a model.
#[derive(Debug)]
struct Its {
    record: Record,
    trust: Trust,
    reaches: Vec<Reach>,
    shown: Vec<f64>,
    are_new: Vec<bool>,
    /// [`Observers::proven`]; empty until it is known.
    proven: Vec<f64>,
}

impl<'a> Observed<'a> {
    /// Renders what the cameras of all models see. Devices that prune their models before upload judge by the cameras
    /// alone. If most models were pruned, the aggregator uses the same rule, so that it assigns no place to a model that
    /// has already dropped it. Otherwise, the splats tell what each model has observed: no single device decides that all
    /// claims are believed.
    pub(super) fn of(
        surveyed: &'a Surveyed,
        computer: &Computer,
        scratch: &Scratch,
    ) -> Result<Self, MergeError> {
        let _span = info_span!("observe").entered();
        let locals = surveyed.locals;
        let (mut seen, mut places, mut pixels_m) = (scratch.records()?, Vec::new(), Vec::new());
        for i in 0..locals.count() {
            let Model { splats, cameras } = locals.load(i)?;
            let Computer { device, threads } = computer;
            let observations = Observations::of(&splats, &cameras, device, *threads)?;
            pixels_m.extend(observations.pixel_m());
            places.push(seen.put(&observations)?);
        }
        let pixel_m = usual(pixels_m);
        let (mut records, mut models) = (scratch.records()?, Vec::new());
        for (i, place) in places.into_iter().enumerate() {
            let mut observations: Observations = seen.get(place)?;
            if let Some(pixel_m) = pixel_m {
                observations.measure(&locals.load(i)?.splats, pixel_m);
            }
            models.push(Its {
                record: records.put(&observations)?,
                trust: locals.trust(i),
                reaches: observations.reaches(),
                shown: observations.shown(),
                are_new: observations.are_new(),
                proven: Vec::new(),
            });
        }
        let shown_min = shown_min(models.iter().map(|its| its.shown.as_slice()));
        let compressed = (0..locals.count()).filter(|i| locals.is_compressed(*i)).count();
        let as_announced = 2 * compressed > locals.count();
        let mut observed = Self { cameras: &surveyed.cameras, records, models, shown_min, as_announced };
        for local in 0..locals.count() {
            if let Some((observers, place)) = observed.around_all_it_sees(local)? {
                observed.models[local].proven = observers.proven(place);
            }
        }
        Ok(observed)
    }

    /// The models with cameras that may see some point within `radius` of `center`, ascending.
    pub(super) fn near(&self, center: DVec3, radius: f64) -> Vec<usize> {
        let is_near = |local: &usize| {
            let cameras = self.cameras[*local].iter().enumerate();
            cameras.into_iter().any(|(i, camera)| {
                let reaches = self.as_announced || self.reaches(*local, i, center, radius);
                reaches && Frustum::new(camera).touches(center, radius)
            })
        };
        (0..self.models.len()).filter(is_near).collect()
    }

    /// Whether the surface that a camera sees, or what lies in front of it, comes within `radius` of `center`.
    pub(super) fn reaches(&self, local: usize, camera: usize, center: DVec3, radius: f64) -> bool {
        self.models[local].reaches[camera].touches(center, radius)
    }

    /// The observations of a model.
    pub(super) fn load(&self, local: usize) -> Result<Observations, MergeError> {
        Ok(self.records.get(self.models[local].record)?)
    }

    /// For each camera of a model: the share of its picture in which the model shows a surface, 0..=1.
    pub(super) fn shown(&self, local: usize) -> &[f64] {
        &self.models[local].shown
    }

    /// Share of the cameras of a model that are not believed, because the model has few splats where they look, 0..=1.
    pub(super) fn unproven(&self, local: usize) -> f64 {
        let proven = &self.models[local].proven;
        let unproven = proven.iter().filter(|proven| **proven < PROVEN_MIN).count();
        unproven as f64 / proven.len().max(1) as f64
    }

    /// For each camera of a model: false if an earlier one has almost the same view.
    pub(super) fn are_new(&self, local: usize) -> &[bool] {
        &self.models[local].are_new
    }

    /// The observations of the model `own`, and of all models with cameras that may see some point within `radius` of
    /// `center`. Also returns the place of `own` among them.
    pub(super) fn around(
        &self,
        own: usize,
        center: DVec3,
        radius: f64,
    ) -> Result<(Observers, usize), MergeError> {
        let mut locals = self.near(center, radius);
        let place = locals.binary_search(&own).unwrap_or_else(|place| {
            locals.insert(place, own);
            place
        });
        let mut observers = Observers::default();
        for (at, local) in locals.into_iter().enumerate() {
            observers.add_observed(self.load(local)?, self.models[local].trust);
            observers.note_proven(at, &self.models[local].proven);
        }
        observers.believe(self.shown_min);
        if self.as_announced {
            observers.judge_as_announced();
        }
        Ok((observers, place))
    }

    /// How well a model observed the surface in the pictures of its own cameras, compared with the model that observed
    /// it best: [`Observers::standings`].
    pub(super) fn standings(&self, own: usize) -> Result<Vec<f64>, MergeError> {
        let around = self.around_all_it_sees(own)?;
        Ok(around.map_or(Vec::new(), |(observers, place)| observers.standings(place)))
    }

    /// As [`Self::around`], around all that the cameras of a model see; `None` if it has no cameras.
    fn around_all_it_sees(&self, own: usize) -> Result<Option<(Observers, usize)>, MergeError> {
        let none = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let reaches = &self.models[own].reaches;
        let (low, high) =
            reaches.iter().fold(none, |(low, high), its| (low.min(its.low), high.max(its.high)));
        let around = || self.around(own, 0.5 * (low + high), 0.5 * low.distance(high));
        (!reaches.is_empty()).then(around).transpose()
    }
}

/// The width of a pixel on the ground with which all models are measured: the median of theirs, so that no model decides for
/// the others. When the first one did, hidden cameras with a focal length of 1e12 cost rendered Boruszyn 7.5 dB.
fn usual(mut pixels_m: Vec<f64>) -> Option<f64> {
    pixels_m.sort_unstable_by(f64::total_cmp);
    pixels_m.get(pixels_m.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::usual;

    #[test]
    fn no_model_decides_alone_in_what_all_are_measured() {
        for absurd in [1e-12, 1e12] {
            let widths =
                [[absurd, 0.5, 0.6], [0.5, 0.6, absurd], [0.6, absurd, 0.5]].map(|of| usual(of.to_vec()));
            assert!(widths.iter().all(|width| [Some(0.5), Some(0.6)].contains(width)), "{widths:?}");
        }
        assert_eq!(usual(Vec::new()), None);
    }
}
