//! Local Model Compression (CoSurfGS, Eq. 5): where models overlap, only one of them keeps its splats: the owner of the
//! ground.
//!
//! The paper does not define the overlap of drones that share no pictures, nor the owner of shared ground. It removes
//! the least important splats of a model, as many as its share of overlapping views. That leaves two surfaces in one
//! place. Here, the owner of a place is the model whose cameras observed it best: with most pixels on a square metre,
//! squared and added up over all cameras that see it, so that sharp pictures are worth more than many blurred ones. If
//! the models are known, pixels count less where a surface is seen from the side, and not at all where it is hidden. A
//! model that disagrees with the others counts less as well, and so does one that shows nothing where many of its
//! cameras look. So does a model whose splats lie thinly where those of others lie densely ([`density`]).
//!
//! Every place has at most one owner, whatever the order of compression, and the owner keeps all of its splats there.

mod cells;
mod density;
mod observer;
mod slopes;
mod surface;
#[cfg(test)]
mod tests;
mod trust;

use cosurf_scene::{Camera, Splats};
use glam::DVec3;
use rayon::prelude::*;
use tracing::info_span;

use crate::device::{Device, DeviceError};
use cells::cells;
use observer::{Near, Observer, Said, shown_mostly};
use slopes::Slopes;
use surface::{BEHIND, median};

pub use cells::longest_side;
pub use density::Density;
pub use observer::{Observations, PROVEN_MIN};
pub use surface::Reach;
pub use trust::Trust;

/// Cosine of the largest angle, 30°, between the lines of sight of two cameras that see a point alike.
const SIGHT_COSINE_MIN: f64 = 0.866_025_403_784_438_6;
/// Range of the ratio of the depths of a point in two cameras that see it alike.
const DEPTH_RATIO: std::ops::RangeInclusive<f64> = 0.5..=2.0;
/// Smallest number of a model's cameras that must see a place so that the model can own it. With one camera, the model
/// may show nothing there, because training may have removed splats that only one camera sees.
const OWNER_CAMERAS_MIN: usize = 2;
/// A camera is not believed if the share of its picture in which its model shows a surface is smaller than that of most
/// cameras of most models by this factor: a model shows what its cameras saw. Cameras of missions show at least 0.88 of
/// their pictures; two of three of rendered Boruszyn's cameras with inverted poses show less than 0.5. Believed, they
/// take ground and cost 0.4 dB.
const SHOWN_SHARE_MIN: f64 = 0.5;

/// Where no other model looks, a splat is hidden only if it is deeper than the surface by more than this factor. At the
/// border of a site, many splats that are needed lie up to a fifth behind the surface in all pictures: with [`BEHIND`] there
/// too, two halves of the built-in city have 24.28 dB instead of 24.44 after they are merged. Where others look, [`BEHIND`]
/// is needed: six white splats a tenth below the ground of Caliterra cost 0.3 dB with it, and 0.8 dB with this.
const BEHIND_ALONE: f32 = 1.2;

/// What the cameras of all models observed.
#[derive(Clone, Debug, Default)]
pub struct Observers {
    each: Vec<Observer>,
    slopes: Option<Slopes>,
    /// True to judge by the cameras alone.
    as_announced: bool,
}

impl Observers {
    /// Adds the next model by its cameras alone. All devices that compress add the same cameras in the same order. So
    /// they agree on the owner of every place, and no place is left out by all.
    pub fn announce(&mut self, cameras: &[Camera]) {
        self.each.push(Observer::announced(cameras));
        self.as_announced = true;
    }

    /// Adds the next model. Its `splats` show what is hidden from its `cameras`, and from where the ground is seen from
    /// the side. The CPU uses `threads` threads, at least 1.
    pub fn add(
        &mut self,
        splats: &Splats,
        cameras: &[Camera],
        trust: Trust,
        device: &Device,
        threads: usize,
    ) -> Result<(), DeviceError> {
        let mut observations = Observations::of(splats, cameras, device, threads)?;
        if let Some(pixel_m) = self.slopes.as_ref().map(Slopes::pixel_m).or(observations.pixel_m()) {
            observations.measure(splats, pixel_m);
        }
        self.add_observed(observations, trust);
        for own in 0..self.each.len() {
            let proven = self.proven(own);
            self.note_proven(own, &proven);
        }
        let shown: Vec<Vec<f64>> = self.each.iter().map(|observer| observer.shown().collect()).collect();
        self.believe(shown_min(shown.iter().map(Vec::as_slice)));
        Ok(())
    }

    /// Adds the observations of the next model, as [`Self::add`] does. All models must be measured with the same width of
    /// a pixel. The caller must then decide which cameras are believed: [`Self::believe`].
    pub fn add_observed(&mut self, observations: Observations, trust: Trust) {
        let (observer, slopes) = Observer::of(observations, trust);
        match (&mut self.slopes, slopes) {
            (Some(all), Some(its)) => all.add(&its),
            (all @ None, its) => *all = its,
            (Some(_), None) => {}
        }
        self.each.push(observer);
    }

    /// From now on, believes only cameras that show a surface in at least this share of their pictures, 0..=1; see
    /// [`shown_min`]. What they show must be proven as well ([`Self::note_proven`]).
    pub fn believe(&mut self, shown_min: f64) {
        self.each.iter_mut().for_each(|observer| observer.believe(shown_min));
    }

    /// From now on, judges by the cameras alone, as devices do that know the other models only by [`Self::announce`].
    pub fn judge_as_announced(&mut self) {
        self.as_announced = true;
    }

    /// For each camera of the model with the index `own`: how well the model observed the surface in the picture,
    /// compared with the model that observed it best. It is the ratio of the worths, 0..=1, mean over the picture; 0 if
    /// there is no surface.
    pub fn standings(&self, own: usize) -> Vec<f64> {
        let surfaces: Vec<Vec<DVec3>> = self.each[own].surfaces().collect();
        let standing = |surface: &Vec<DVec3>| {
            let ground = self.ground(surface);
            let sum: f64 = surface.iter().map(|place| ground.standing(*place, own)).sum();
            sum / surface.len().max(1) as f64
        };
        surfaces.par_iter().map(standing).collect()
    }

    /// For each camera of the model with the index `own`: how densely the model's splats lie on the surface in the
    /// picture, as a share of those of the densest model there, 0..=1; 1 if there is no surface.
    pub fn proven(&self, own: usize) -> Vec<f64> {
        let surfaces: Vec<Vec<DVec3>> = self.each[own].surfaces().collect();
        let proven = |surface: &Vec<DVec3>| {
            let sum: f64 = surface.iter().map(|place| self.share_of_densest(*place, own)).sum();
            if surface.is_empty() { 1.0 } else { sum / surface.len() as f64 }
        };
        surfaces.par_iter().map(proven).collect()
    }

    /// Notes what [`Self::proven`] says of the cameras of a model; counts only after [`Self::believe`].
    pub fn note_proven(&mut self, own: usize, proven: &[f64]) {
        self.each[own].note_proven(proven);
    }

    fn share_of_densest(&self, place: DVec3, own: usize) -> f64 {
        let dense = densest(self.each.iter().map(|its| its.density(place)));
        let density = self.each[own].density(place);
        density.map_or(1.0, |density| if density < dense { density / dense } else { 1.0 })
    }

    /// Prepares to judge some places that lie near each other.
    fn ground(&self, places: &[DVec3]) -> Ground<'_> {
        let center = places.iter().sum::<DVec3>() / places.len().max(1) as f64;
        let radius = places.iter().map(|place| place.distance(center)).fold(0.0, f64::max);
        let near =
            self.each.iter().map(|observer| observer.near(center, radius, self.as_announced)).collect();
        let slopes = self.slopes.as_ref().filter(|_| !self.as_announced);
        Ground { near, slopes }
    }
}

/// The smallest share of its picture in which a camera that is believed shows a surface, if the models of a site show
/// these shares, each in the pictures of its own cameras.
pub fn shown_min<'a>(shown: impl Iterator<Item = &'a [f64]>) -> f64 {
    SHOWN_SHARE_MIN * median(shown.filter_map(shown_mostly).collect(), f64::total_cmp).unwrap_or(0.0)
}

/// The cameras that may see some places.
struct Ground<'a> {
    near: Vec<Near<'a>>,
    slopes: Option<&'a Slopes>,
}

/// How the model that is compressed saw a place beside the others.
struct Verdict {
    /// Whether the model loses its splats of the place.
    is_lost: bool,
    /// Whether another model could own the place.
    is_shared: bool,
}

impl Ground<'_> {
    /// `own` is the index of the model that is compressed. The owner of a place is the model whose observations are
    /// worth most; of several, the first. If a second model whose observations are worth almost as much keeps its splats
    /// too, rendered Boruszyn and Caliterra gain 0.02 dB and 10 % more splats. But the surface is there twice then: a copy
    /// of a model with few changes costs 0.7 dB.
    fn verdict(&self, place: DVec3, own: usize) -> Verdict {
        let dense = densest(self.near.iter().map(|near| near.density(place)));
        let said: Vec<Said> = self.near.iter().map(|near| near.said(place, self.slopes)).collect();
        // Two cameras must show something, and as many as look through the place.
        let worth = |model: usize| match said[model] {
            Said { showing, through, worth } if showing >= OWNER_CAMERAS_MIN.max(through) => {
                worth * observed(&self.near[model], place, dense)
            }
            _ => 0.0,
        };
        // Others look through what only this model shows. Splats in mid-air, each before a single camera of another model,
        // which can own nothing, cost rendered Boruszyn 5.6 dB. The number of votes of a model is limited, so that it cannot
        // outvote all others with invented cameras. If only its own cameras see the place, the splats stay: what a model
        // shows at the border of its ground is better than nothing.
        let through: usize = said.iter().map(|said| said.through).sum();
        let showing: usize = said.iter().map(|said| said.showing).sum();
        let is_refuted = through > showing && through > said[own].through;
        let of_own = worth(own);
        let (mut is_lost, mut is_shared) = (is_refuted || self.is_hidden(place, own), false);
        for (model, worth) in (0..said.len()).filter(|model| *model != own).map(|model| (model, worth(model)))
        {
            is_shared |= worth > 0.0;
            is_lost |= worth > of_own || (worth == of_own && worth > 0.0 && model < own);
        }
        Verdict { is_lost, is_shared }
    }

    /// Whether the surface hides a splat of the model from all of its cameras: no picture of the model can have shown it. But
    /// the splat shines through the ground all the same: six white splats 40 m below rendered Boruszyn cost 2.5 dB. If the
    /// splat lies in none of the model's pictures, those of all others decide. Nothing is hidden from cameras that are judged
    /// by themselves.
    fn is_hidden(&self, place: DVec3, own: usize) -> bool {
        let its = &self.near[own];
        if its.contains(place) {
            let mut each = self.near.iter().enumerate();
            let others_look = each.any(|(model, near)| model != own && near.contains(place));
            return !its.sees(place, if others_look { BEHIND } else { BEHIND_ALONE });
        }
        self.near.iter().any(|near| near.contains(place))
            && !self.near.iter().any(|near| near.sees(place, BEHIND))
    }

    /// The worth of a model's observations, as a share of the largest worth of all models, 0..=1.
    fn standing(&self, place: DVec3, own: usize) -> f64 {
        let dense = densest(self.near.iter().map(|near| near.density(place)));
        let worth = |near: &Near| near.said(place, self.slopes).worth * observed(near, place, dense);
        let most = self.near.iter().map(worth).fold(f64::MIN_POSITIVE, f64::max);
        worth(&self.near[own]) / most
    }
}

/// The density of the densest model, given those of all, each as a multiple of what is usual in the model; 0..=1. More
/// than usual does not count: a model with splats heaped up must not make others look thin.
fn densest(densities: impl Iterator<Item = Option<f64>>) -> f64 {
    densities.flatten().fold(0.0, f64::max).min(1.0)
}

/// The factor on the worth of a model's observations of a place where the densest model's splats lie `dense`, 0..=1. A
/// model whose splats lie thinly there was hardly trained on what its cameras claim. As worth does, the factor grows with
/// the square of what is seen. A fifth model of rendered Boruszyn that claims the cameras of all four others costs 4.0 dB
/// without it, and 0.8 with it; with [`PROVEN_MIN`] as well, nothing. Honest missions change by 0.03
/// dB at most.
fn observed(near: &Near, place: DVec3, dense: f64) -> f64 {
    near.density(place).map_or(1.0, |density| if density < dense { (density / dense).powi(2) } else { 1.0 })
}

/// What compression removes from a model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Compression {
    /// Share of the model's splats on ground that other models saw too, 0..=1.
    pub overlap: f64,
    /// Indices of the removed splats, ascending.
    pub removed: Vec<u32>,
}

impl Compression {
    /// Decides which splats compression removes from the model with the index `own`: those on ground that another of
    /// `observers` owns.
    pub fn plan(splats: &Splats, own: usize, observers: &Observers) -> Self {
        let _span = info_span!("compress", model = own, splats = splats.len()).entered();
        let judge = |cell: &Vec<u32>| judged(cell, splats, own, observers);
        let found: Vec<(usize, Vec<u32>)> = cells(splats).par_iter().map(judge).collect();
        let shared = found.iter().map(|(shared, _)| shared).sum::<usize>();
        let mut removed: Vec<u32> = found.into_iter().flat_map(|(_, removed)| removed).collect();
        removed.sort_unstable();
        Self { overlap: shared as f64 / splats.len().max(1) as f64, removed }
    }
}

/// Of the splats of a cell: how many lie on ground that other models saw too, and those that the model loses.
fn judged(cell: &[u32], splats: &Splats, own: usize, observers: &Observers) -> (usize, Vec<u32>) {
    let place = |i: &u32| DVec3::from_array(splats.means[*i as usize].map(f64::from));
    let ground = observers.ground(&cell.iter().map(place).collect::<Vec<_>>());
    let (mut shared, mut lost) = (0, Vec::new());
    for i in cell {
        let Verdict { is_lost, is_shared } = ground.verdict(place(i), own);
        shared += usize::from(is_shared);
        if is_lost {
            lost.push(*i);
        }
    }
    (shared, lost)
}

/// Whether `other` sees a point from a similar direction and distance as `camera`. `camera` itself may look elsewhere.
pub fn sees_alike(camera: &Camera, other: &Camera, point: DVec3) -> bool {
    let sight = |camera: &Camera| (point - camera.cam_from_world.center()).normalize_or_zero();
    let depth = |camera: &Camera| camera.cam_from_world.transform(point).z;
    other.sees(point)
        && sight(camera).dot(sight(other)) >= SIGHT_COSINE_MIN
        && DEPTH_RATIO.contains(&(depth(other) / depth(camera)))
}
