//! What the cameras of one model observe, and what their observations of a place are worth.

use cosurf_scene::{Camera, Frustum, Splats};
use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::cells::cells;
use super::density::{Counts, Density};
use super::slopes::{SLOPES_PX, Slopes};
use super::surface::{Look, Reach, Surface, Visibility, median};
use super::trust::Trust;
use crate::device::{Device, DeviceError};
use crate::render::Renderer;

/// A splat proves that its model observed a place if the splat lies on the surface: deeper than the surface by at most this
/// factor, in at least [`PROVING_SHARE_MIN`] of the pictures that contain the splat. Of trained splats, 99 % lie on the
/// surface by this rule. Of 67,000 splats 6 m below the ground of rendered Boruszyn, 4 % do; with the factor
/// [`super::surface::BEHIND`] and any single picture, 73 % would.
const BEHIND_PROVING: f32 = 1.02;
/// See [`BEHIND_PROVING`].
const PROVING_SHARE_MIN: f64 = 0.25;
/// A camera is not believed if its model's splats, where it looks, are on average less than this many times as dense as
/// those of the densest model there. Of the cameras of honest missions, one in a hundred is below this limit (the lowest has
/// 0.49), and nine in ten have more than 0.75. Of a model that claims the cameras of all four others, three in ten are below.
pub const PROVEN_MIN: f64 = 0.6;
/// At each place, at most this many cameras of a model count: those with most pixels there. Without a limit, a model with
/// invented cameras takes ground: its own cameras, repeated with small changes, are not recognised as copies. In three
/// missions, a limit of 16 costs 0.01 dB, and one of 10 costs 0.04 dB.
pub(super) const COUNTED_MAX: usize = 16;

/// What the cameras of one model observed, as a value that can be written to a file:
/// [`Observers::add_observed`](super::Observers::add_observed).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Observations {
    cameras: Vec<Camera>,
    /// The surface in the picture of each camera.
    surfaces: Vec<Surface>,
    /// `None` until they are measured.
    measured: Option<Measured>,
}

/// What is measured of a model in cubes, which have the same side for all models.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Measured {
    slopes: Slopes,
    /// Of the splats that some camera sees.
    counts: Counts,
}

impl Observations {
    /// What `cameras` see of the model `splats`. The CPU uses `threads` threads, at least 1. The model must be measured
    /// too: [`Self::measure`].
    pub fn of(
        splats: &Splats,
        cameras: &[Camera],
        device: &Device,
        threads: usize,
    ) -> Result<Self, DeviceError> {
        let mut renderer = Renderer::by(device, threads, splats)?;
        let surfaces: Vec<Surface> = cameras
            .iter()
            .map(|camera| Surface::render(&mut renderer, camera))
            .collect::<Result<_, DeviceError>>()?;
        Ok(Self { cameras: cameras.to_vec(), surfaces, measured: None })
    }

    /// Measures how the ground of the model slopes, and how densely its splats lie. `pixel_m` is the width of a pixel on
    /// the ground, world units, above 0; it must be the same for all models.
    pub fn measure(&mut self, splats: &Splats, pixel_m: f64) {
        let side = SLOPES_PX * pixel_m;
        let counts = Counts::of(splats, self.proving(splats).into_iter(), side);
        self.measured = Some(Measured { slopes: Slopes::of(splats, side), counts });
    }

    /// Indices of the splats that prove what the model observed. What the surface hides proves nothing: with 67,000 splats
    /// heaped up 6 m below rendered Boruszyn, a model looked as if it had observed all of it.
    pub(super) fn proving(&self, splats: &Splats) -> Vec<usize> {
        let observer = Observer::of_surfaces(&self.cameras, &self.surfaces);
        let of_cell = |cell: &Vec<u32>| {
            let place = |i: u32| DVec3::from_array(splats.means[i as usize].map(f64::from));
            let (low, high) = cell.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), i| {
                (low.min(place(*i)), high.max(place(*i)))
            });
            let near = observer.near(0.5 * (low + high), 0.5 * low.distance(high), false);
            cell.iter().filter(|i| near.proves(place(**i))).map(|i| *i as usize).collect::<Vec<_>>()
        };
        cells(splats).par_iter().flat_map_iter(of_cell).collect()
    }

    /// Width that a pixel covers on the ground, world units: the median of all cameras. `None` if none sees ground.
    pub fn pixel_m(&self) -> Option<f64> {
        let width = |(camera, surface): (&Camera, &Surface)| {
            Some(surface.median_depth()? / (camera.focal_px.x * camera.focal_px.y).sqrt())
        };
        median(self.cameras.iter().zip(&self.surfaces).filter_map(width).collect(), f64::total_cmp)
    }

    /// For each camera: the share of its picture in which the model shows a surface, 0..=1.
    pub fn shown(&self) -> Vec<f64> {
        self.surfaces.iter().map(Surface::share).collect()
    }

    /// For each camera: a box around all that it sees.
    pub fn reaches(&self) -> Vec<Reach> {
        self.surfaces.iter().map(Surface::reach).collect()
    }

    /// For each camera: false if an earlier one has almost the same view.
    pub fn are_new(&self) -> Vec<bool> {
        are_new(&self.cameras, |camera| self.surfaces[camera].median_depth().unwrap_or(0.0))
    }

    /// Points of the surface in the picture of a camera, evenly spaced, about 24 along the long side.
    pub fn surface(&self, camera: usize) -> Vec<DVec3> {
        self.surfaces[camera].points()
    }
}

/// For each camera: false if an earlier one has almost the same view of what lies at the depth of the camera with this
/// index.
fn are_new(cameras: &[Camera], depth: impl Fn(usize) -> f64) -> Vec<bool> {
    let is_new = |i: usize| {
        let depth = depth(i);
        !cameras[..i].iter().any(|earlier| cameras[i].views_alike(earlier, depth))
    };
    (0..cameras.len()).map(is_new).collect()
}

/// The median share of a picture that shows a surface; `None` without cameras.
pub(super) fn shown_mostly(shown: &[f64]) -> Option<f64> {
    median(shown.to_vec(), f64::total_cmp)
}

/// The cameras of one model, with the depths of the surface that they see.
#[derive(Clone, Debug)]
pub(super) struct Observer {
    sights: Vec<Sight>,
    trust: Trust,
    /// Share of the cameras that are believed, 0..=1.
    believed: f64,
    /// `None` if the model is not known, or if it was not measured.
    density: Option<Density>,
}

/// A camera, and the surface that it sees.
#[derive(Clone, Debug)]
struct Sight {
    frustum: Frustum,
    eye: DVec3,
    /// Product of the focal lengths, px².
    focal2_px: f64,
    /// False if an earlier camera of the model has almost the same view: copies of a camera must not gain ground.
    counts: bool,
    /// False if the model shows too little of what the camera says to have seen.
    is_believed: bool,
    /// How dense the model's splats are where the camera looks, as a share of the densest model's, 0..=1.
    proven: f64,
    /// Share of the picture that shows a surface, 0..=1; 0 if the model is not known.
    shown: f64,
    /// `None` if the model is not known. Then nothing is hidden from the camera.
    visibility: Option<Visibility>,
    /// A box around all that the camera sees of the surface and in front of it; `None` if the model is not known.
    reach: Option<Reach>,
}

/// Those cameras of a model that may see some place of a ball.
pub(super) struct Near<'a> {
    sights: Vec<&'a Sight>,
    /// Cameras with the place in their pictures, but farther away than all that they see.
    beyond: Vec<&'a Sight>,
    trust: Trust,
    density: Option<&'a Density>,
    /// True to judge by the cameras alone: nothing is hidden from them, and all is believed.
    sees_through: bool,
}

impl Observer {
    /// The observations of cameras whose model is not known.
    pub(super) fn announced(cameras: &[Camera]) -> Self {
        let counts = are_new(cameras, |_| 0.0);
        let sight = |(camera, counts)| Sight::new(camera, None, counts);
        let sights = cameras.iter().zip(counts).map(sight).collect();
        Self { sights, trust: Trust::FULL, believed: 1.0, density: None }
    }

    /// The observations of the cameras of a model. Also returns the slopes of its ground.
    pub(super) fn of(observations: Observations, trust: Trust) -> (Self, Option<Slopes>) {
        let are_new = observations.are_new();
        let Observations { cameras, surfaces, measured } = observations;
        let sight = |((camera, surface), is_new)| Sight::new(camera, Some(surface), is_new);
        let sights = cameras.iter().zip(surfaces).zip(are_new).map(sight).collect();
        let density = measured.as_ref().map(|measured| Density::from(&measured.counts));
        (Self { sights, trust, believed: 1.0, density }, measured.map(|measured| measured.slopes))
    }

    /// The cameras with what they see. Copies of cameras count too.
    fn of_surfaces(cameras: &[Camera], surfaces: &[Surface]) -> Self {
        let sight = |(camera, surface): (&Camera, &Surface)| Sight::new(camera, Some(surface.clone()), true);
        Self {
            sights: cameras.iter().zip(surfaces).map(sight).collect(),
            trust: Trust::FULL,
            believed: 1.0,
            density: None,
        }
    }

    /// From now on, believes only cameras with a surface in at least this share of their pictures, 0..=1, and with enough
    /// splats there. Where many cameras are not believed, the others count less as well: they can hardly be right.
    pub(super) fn believe(&mut self, shown_min: f64) {
        let is_believed = |sight: &Sight| sight.shown >= shown_min && sight.proven >= PROVEN_MIN;
        self.sights.iter_mut().for_each(|sight| sight.is_believed = is_believed(sight));
        let believed = self.sights.iter().filter(|sight| sight.is_believed).count();
        self.believed = believed as f64 / self.sights.len().max(1) as f64;
    }

    /// How densely the model's splats lie around `place`, as a multiple of what is usual in the model. `None` if that is
    /// not known.
    pub(super) fn density(&self, place: DVec3) -> Option<f64> {
        self.density.as_ref().map(|density| density.at(place))
    }

    /// For each camera: how dense the splats are where it looks, as a share of the densest model's, 0..=1.
    pub(super) fn note_proven(&mut self, proven: &[f64]) {
        self.sights.iter_mut().zip(proven).for_each(|(sight, proven)| sight.proven = *proven);
    }

    /// Those cameras that may see some point within `radius` of `center`. With `sees_through`, they are judged by
    /// themselves: all is believed, and nothing is hidden from them.
    pub(super) fn near(&self, center: DVec3, radius: f64, sees_through: bool) -> Near<'_> {
        let counts = |sight: &Sight| sight.counts && (sees_through || sight.is_believed);
        let reaches =
            |sight: &Sight| sees_through || sight.reach.is_none_or(|reach| reach.touches(center, radius));
        let looks_there = |sight: &&Sight| counts(sight) && sight.frustum.touches(center, radius);
        let (sights, beyond) =
            self.sights.iter().filter(looks_there).partition(|sight: &&Sight| reaches(sight));
        let Trust { weight, pixels_max } = self.trust;
        let trust = Trust { weight: weight * self.believed.powi(2), pixels_max };
        let trust = if sees_through { Trust::FULL } else { trust };
        let density = self.density.as_ref().filter(|_| !sees_through);
        Near { sights, beyond, trust, density, sees_through }
    }

    /// Share of each camera's picture that shows a surface, 0..=1; 0 if the model is not known.
    pub(super) fn shown(&self) -> impl Iterator<Item = f64> {
        self.sights.iter().map(|sight| sight.shown)
    }

    /// Points on the surface in the picture of each camera: one for every second pixel of every second row.
    pub(super) fn surfaces(&self) -> impl Iterator<Item = Vec<DVec3>> {
        self.sights.iter().map(|sight| sight.visibility.as_ref().map_or(Vec::new(), Visibility::points))
    }
}

impl Near<'_> {
    /// Whether `place` lies in the picture of some camera.
    pub(super) fn contains(&self, place: DVec3) -> bool {
        self.sights.iter().chain(&self.beyond).any(|sight| sight.frustum.contains(place))
    }

    /// Whether `place` lies in the picture of some camera, not deeper than the surface by more than the factor `behind`.
    pub(super) fn sees(&self, place: DVec3, behind: f32) -> bool {
        let mut all = self.sights.iter().chain(&self.beyond);
        all.any(|sight| sight.sees(place, self.sees_through, behind))
    }

    /// Whether a splat at `place` proves that the model observed what lies there.
    fn proves(&self, place: DVec3) -> bool {
        let contains = |sight: &&&Sight| sight.frustum.contains(place);
        let shows =
            |sight: &&Sight| sight.visibility.as_ref().is_none_or(|its| its.shows(place, BEHIND_PROVING));
        let [mut pictures, mut seen] = [self.beyond.iter().filter(contains).count(), 0];
        for sight in self.sights.iter().filter(contains) {
            pictures += 1;
            seen += usize::from(shows(sight));
        }
        seen > 0 && seen as f64 >= PROVING_SHARE_MIN * pictures as f64
    }

    /// As [`Observer::density`]; `None` also if the model is judged by its cameras alone.
    pub(super) fn density(&self, place: DVec3) -> Option<f64> {
        self.density.map(|density| density.at(place))
    }

    /// What the best [`COUNTED_MAX`] cameras say of `place`. What their observations are worth together is the square of the
    /// number of pixels on a square of one world unit, for each that sees a surface there; added up, times the weight of the
    /// model.
    ///
    /// Without the square, many blurred pictures are worth as much as a few sharp ones. Then a fifth model, of 160 px
    /// beside four of 240 px, took ground on rendered Boruszyn and cost 0.9 dB; with it, it costs nothing.
    pub(super) fn said(&self, place: DVec3, slopes: Option<&Slopes>) -> Said {
        let slope = slopes.and_then(|slopes| slopes.at(place));
        let mut best = [None; COUNTED_MAX];
        for sight in &self.sights {
            let Some(look) = sight.look(place, self.sees_through) else { continue };
            let ray = place - sight.eye;
            let foreshortening = slope.map_or(1.0, |slope| slope.foreshortening(ray));
            let pixels = (sight.focal2_px / ray.length_squared()).min(self.trust.pixels_max);
            insert(&mut best, ((pixels * foreshortening).powi(2), look));
        }
        let mut said = Said::default();
        for (worth, look) in best.into_iter().flatten() {
            match look {
                Look::Through => said.through += 1,
                Look::Showing => {
                    said.showing += 1;
                    said.worth += self.trust.weight * worth;
                }
            }
        }
        said
    }
}

/// What the cameras of a model say of a place.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Said {
    /// Number of cameras that see a surface there.
    pub(super) showing: usize,
    /// Number of cameras that see a surface far behind, and nothing there.
    pub(super) through: usize,
    /// What the observations are worth.
    pub(super) worth: f64,
}

/// Puts what a camera sees among what the best cameras see. The best come first.
fn insert(best: &mut [Option<(f64, Look)>], seen: (f64, Look)) {
    let place = best.partition_point(|other| other.is_some_and(|other| other.0 >= seen.0));
    if place < best.len() {
        best[place..].rotate_right(1);
        best[place] = Some(seen);
    }
}

impl Sight {
    /// `counts` is false if an earlier camera of the model has almost the same view.
    fn new(camera: &Camera, surface: Option<Surface>, counts: bool) -> Self {
        Self {
            frustum: Frustum::new(camera),
            eye: camera.cam_from_world.center(),
            focal2_px: camera.focal_px.x * camera.focal_px.y,
            counts,
            is_believed: true,
            proven: 1.0,
            shown: surface.as_ref().map_or(0.0, Surface::share),
            reach: surface.as_ref().map(Surface::reach),
            visibility: surface.map(Visibility::new),
        }
    }

    /// What the camera sees at `place`; `None` if that is hidden or outside the picture.
    fn look(&self, place: DVec3, sees_through: bool) -> Option<Look> {
        if !self.frustum.contains(place) {
            return None;
        }
        match self.visibility.as_ref().filter(|_| !sees_through) {
            Some(visibility) => visibility.look(place),
            None => Some(Look::Showing),
        }
    }

    /// Whether `place` lies in the picture, not deeper than the surface by more than the factor `behind`.
    fn sees(&self, place: DVec3, sees_through: bool, behind: f32) -> bool {
        self.frustum.contains(place)
            && (sees_through || self.visibility.as_ref().is_none_or(|its| its.shows(place, behind)))
    }
}
