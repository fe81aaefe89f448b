//! Decides which models take part in a merge. A model that contradicts others stays on the disk, but is kept out of
//! merges until it contradicts no other model.
//!
//! The gate renders small pictures of each model from some of its cameras. If the cameras of another model see the
//! same ground, the other model must give the same pictures ([`glimpse`]). A forged model does not, nor does a model
//! in another frame or scale. The gate also keeps out a model that does not fit its own cameras: most of its splats lie
//! where none of them looks, or most of their pictures show no surface. It keeps out a model so far from all others
//! that its origin must be wrong, and one that shows shared ground far worse than the others do ([`quality`]). A model
//! that is worse, or whose colours differ from the others' more in one part than in another ([`evenness`]), counts less. A
//! model that shows less detail than its pictures claim takes part with smaller pictures ([`sharpness`]). Nobody can
//! know beforehand which pictures are compared ([`chosen`]).
//!
//! A model that shares no ground with the others cannot be verified: its frame may be another one. It is accepted only
//! if the frames of all models are vouched for.
//!
//! Of two conflicting models, the gate drops the one with more conflicts net of confirmations. On a tie, it drops the
//! one with fewer cameras, and then the one with the higher index. [`Locals`] gives the models in a fixed order, so the
//! verdict does not depend on the order of arrival.
//!
//! Before that, unless the settings forbid it, models are moved so that the ground they share lies at the same place in
//! all of them ([`frames`]). The colours of the admitted models are matched to each other ([`tone`]).
//!
//! What it knows nothing about: who sent a model, and when. It judges models by what they show, and merges nothing.
//!
//! Where to start reading: [`admit`]; then [`judge`](judge::judge) and [`glimpse`], which compares two models; then
//! [`frames`], [`links`] and [`adjust`], which move models to where they fit; [`part`] for uploads that broke off.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod adjust;
mod chosen;
mod claims;
mod consensus;
mod copies;
mod doubt;
mod evenness;
mod extent;
mod features;
mod frames;
mod glimpse;
mod judge;
mod link_file;
mod links;
mod matching;
mod part;
mod quality;
mod register;
mod scouts;
mod sharpness;
mod similarity;
#[cfg(test)]
pub(crate) mod tests;
mod tone;
mod workspace;

use cosurf_engine::Trust;
use cosurf_link::Model;
use cosurf_scene::{Camera, evenly_spaced};
use tracing::info_span;

use crate::merge::memory::check_models;
use crate::merge::{Locals, MergeError, MergeSettings, ModelSize};
use chosen::choosers;
use copies::Kept;
pub use doubt::Doubt;
use extent::{Extent, extents, held_bytes};
pub use frames::{Fit, Move};
use frames::{Placement, find_frames};
use judge::{Judged, Judgement, judge};
pub(crate) use part::admit_part;
pub use similarity::Similarity;
pub use tone::Tone;
use tone::tones;
pub use workspace::Workspace;

/// Of a model's cameras, one for so many of its splats takes part, evenly spaced: each costs time, and a model cannot
/// teach more than it holds. Models of pictures of 160 px have about 500 splats for each camera.
const SPLATS_PER_CAMERA: usize = 24;
/// So many cameras always take part.
const CAMERAS_MIN: usize = 64;

/// The local models that take part in a merge, with positions and colours that fit each other.
pub struct Admitted<'a> {
    locals: &'a dyn Locals,
    doubts: Vec<Option<Doubt>>,
    /// One [`Place`] for each model that takes part.
    places: Vec<Place>,
    fits: Vec<Fit>,
}

/// How a model takes part in a merge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Index of the model among all models that were judged.
    pub local: usize,
    /// How far the model's observations are believed. The weight is below 1 if the model differs from the others far more
    /// than they differ from each other.
    pub trust: Trust,
    /// Factor on the sides of the model's pictures, 0..=1: below 1 if the model shows less detail than pictures of the
    /// claimed size and distance do in other models. Its cameras are made so much smaller.
    pub size: f64,
    /// Whether the model belongs to the largest group of models that share ground with each other. A single model does.
    pub is_verified: bool,
    /// Share of the pictures of the model's own cameras that show hardly any surface, 0..=1. Such cameras do not count.
    pub void: f64,
    /// How the model is moved to where it fits the others; `None` if its position is right.
    pub by: Option<Move>,
    /// Matches the model's colours to those of the others; `None` if the colours of all models match already.
    pub tone: Option<Tone>,
}

impl Locals for Admitted<'_> {
    fn count(&self) -> usize {
        self.places.len()
    }

    fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
        self.locals.size(self.places[index].local)
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        let Place { local, size, by, tone, .. } = &self.places[index];
        let mut model = self.locals.load(*local)?;
        let cameras_max = CAMERAS_MIN.max(model.splats.len() / SPLATS_PER_CAMERA);
        if model.cameras.len() > cameras_max {
            model.cameras = evenly_spaced(&model.cameras, cameras_max);
        }
        if *size < 1.0 {
            let smaller = |side: u32| ((f64::from(side) * size).round() as u32).max(1);
            let resized = |camera: &mut Camera| *camera = camera.resized(camera.size_px.map(smaller));
            model.cameras.iter_mut().for_each(resized);
        }
        if let Some(by) = by {
            model = by.by.model(&model);
        }
        if let Some(tone) = tone {
            tone.apply(&mut model.splats);
        }
        Ok(model)
    }

    fn is_compressed(&self, index: usize) -> bool {
        self.locals.is_compressed(self.places[index].local)
    }

    fn trust(&self, index: usize) -> Trust {
        self.places[index].trust
    }
}

impl Admitted<'_> {
    /// How the `index`-th admitted model takes part.
    pub fn place(&self, index: usize) -> Place {
        self.places[index]
    }

    /// How well every two models that share ground fit; empty if the settings forbid to move models.
    pub fn fits(&self) -> &[Fit] {
        &self.fits
    }

    /// Index and reason of each model that is kept out. The reason is a sentence without its subject; `names` has the
    /// name of every model.
    pub fn kept_out<N: AsRef<str>>(&self, names: &[N]) -> impl Iterator<Item = (usize, String)> {
        let doubts = self.doubts.iter().enumerate();
        doubts.filter_map(|(i, doubt)| Some((i, doubt.as_ref()?.reason(names))))
    }

    /// The doubt about each model, by index.
    #[cfg(test)]
    pub(crate) fn doubts(&self) -> &[Option<Doubt>] {
        &self.doubts
    }
}

/// What the gate is told about the frames of the models.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frames {
    /// Whether models are moved to where they fit each other.
    pub refine: bool,
    /// Whether all models are known to lie in one frame. Then a model that shares no ground with the others is
    /// accepted.
    pub vouched: bool,
}

impl From<&MergeSettings> for Frames {
    fn from(&MergeSettings { refine, vouched, .. }: &MergeSettings) -> Self {
        Self { refine, vouched }
    }
}

/// Decides which of `locals` take part in a merge. If told so, first moves models to where they fit each other.
/// Then every model that contradicts others is kept out. `is_given_up` is called between models; if it returns true, the
/// result is an error.
pub fn admit<'a>(
    locals: &'a dyn Locals,
    frames: Frames,
    workspace: Workspace,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Admitted<'a>, MergeError> {
    let _span = info_span!("gate", models = locals.count()).entered();
    let held = if frames.refine { 2 } else { 1 };
    check_models(locals, held, workspace.memory_bytes)?;
    let extents = extents(locals, is_given_up)?;
    let kept = Kept::of(locals, &extents);
    let among = admit_originals(&kept, &kept.extents(&extents), frames, workspace, is_given_up)?;
    let of_all = kept.indices();
    let place = |place: Place| Place { local: of_all[place.local], ..place };
    let fit = |fit: Fit| Fit { models: fit.models.map(|model| of_all[model]), ..fit };
    Ok(Admitted {
        locals,
        places: among.places.into_iter().map(place).collect(),
        fits: among.fits.into_iter().map(fit).collect(),
        doubts: kept.doubts(among.doubts),
    })
}

/// As [`admit`], of models without copies.
fn admit_originals<'a>(
    locals: &'a dyn Locals,
    extents: &[Option<Extent>],
    frames: Frames,
    workspace: Workspace,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Admitted<'a>, MergeError> {
    let count = locals.count();
    let Placement { moves, fits } = match frames.refine {
        true => find_frames(locals, extents, frames.vouched, workspace, is_given_up)?,
        false => Placement::unmoved(count),
    };
    let place = |local: usize| Place {
        local,
        trust: Trust::FULL,
        size: 1.0,
        is_verified: true,
        void: 0.0,
        by: moves[local],
        tone: None,
    };
    let mut admitted =
        Admitted { locals, doubts: vec![None; count], places: (0..count).map(place).collect(), fits };
    let linked: Vec<[usize; 2]> = admitted.fits.iter().map(|fit| fit.models).collect();
    let choosers = choosers(extents, &moves);
    let shifts = workspace.shifts(held_bytes(extents));
    let Judgement { judged, colors } =
        judge(&admitted, &choosers, &linked, shifts, workspace.scratch, is_given_up)?;
    let accepted =
        |local: &usize| judged[*local].doubt.is_none() && (frames.vouched || judged[*local].is_verified);
    let place = |local: usize| {
        let Judged { trust, size, is_verified, void, .. } = judged[local];
        Place { trust, size, is_verified, void, ..place(local) }
    };
    admitted.places = (0..count).filter(accepted).map(place).collect();
    let unverified = |local: usize| {
        let doubt = if judged[local].is_blind { Doubt::Blind } else { Doubt::Unverified };
        (!accepted(&local)).then_some(doubt)
    };
    admitted.doubts =
        (0..count).map(|local| judged[local].doubt.clone().or_else(|| unverified(local))).collect();
    let taking_part: Vec<usize> = admitted.places.iter().map(|place| place.local).collect();
    if let Some(tones) = tones(&colors, &taking_part) {
        admitted.places.iter_mut().zip(tones).for_each(|(place, tone)| place.tone = Some(tone));
    }
    Ok(admitted)
}
