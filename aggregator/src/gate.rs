//! Decides which models take part in a merge. A model that contradicts others stays on the disk, but is kept out of
//! merges until it contradicts no other model.
//!
//! The gate renders small pictures of each model from some of its cameras. If the cameras of another model see the
//! same ground, the other model must give the same pictures ([`glimpse`]). A forged model does not, nor does a model
//! in another frame or scale. The gate also keeps out a model with most of its splats where none of its own cameras
//! looks. It keeps out a model so far from all others that its origin must be wrong. Any other model that shares no
//! ground with others is accepted.
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
//! Where to start reading: [`admit`]; then [`glimpse`], which compares two models; then [`frames`], [`links`] and
//! [`adjust`], which move models to where they fit.

mod adjust;
mod consensus;
mod features;
mod frames;
mod glimpse;
mod links;
mod matching;
mod register;
mod similarity;
#[cfg(test)]
pub(crate) mod tests;
mod tone;

use std::collections::BTreeMap;

use cosurf_engine::Renderer;
use cosurf_link::Model;
use cosurf_scene::{Camera, Watchers};
use glam::DVec3;
use tracing::info_span;

use crate::merge::cameras::{middle, radius};
use crate::merge::{Locals, MergeError};
pub use frames::{Fit, Move};
use frames::{Frames, find_frames};
use glimpse::Glimpse;
pub use similarity::Similarity;
pub use tone::Tone;
use tone::tones;

/// Largest accepted share of a model's splats that none of its own cameras sees. Trained models stay far below it.
const UNSEEN_MAX: f64 = 0.5;
/// Largest gap between two flights (the cameras of two models) that can have the same origin, in radii of the larger
/// flight.
const GAP_MAX_RADII: f64 = 20.0;
/// Two models contradict each other only if at least this many views contradict, and more views contradict than
/// confirm.
const CONTRADICTIONS_MIN: u32 = 2;

/// Why a model is kept out of a merge.
#[derive(Clone, Debug, PartialEq)]
pub enum Doubt {
    /// This share of the model's splats, 0..=1, lies where none of its own cameras looks.
    Unseen(f64),
    /// The model contradicts the models with these indices.
    Contradicts(Vec<usize>),
}

impl Doubt {
    /// The reason as a sentence without its subject. `names` has the name of every model.
    pub(crate) fn reason<N: AsRef<str>>(&self, names: &[N]) -> String {
        match self {
            Self::Unseen(share) => {
                format!("has {:.0} % of its splats where none of its cameras looks", 100.0 * share)
            }
            Self::Contradicts(others) => {
                let names: Vec<&str> = others.iter().map(|other| names[*other].as_ref()).collect();
                format!("contradicts {} (different ground, place or scale)", names.join(", "))
            }
        }
    }
}

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
    /// How the model is moved to where it fits the others; `None` if its position is right.
    pub by: Option<Move>,
    /// Matches the model's colours to those of the others; `None` if the colours of all models match already.
    pub tone: Option<Tone>,
}

impl Locals for Admitted<'_> {
    fn count(&self) -> usize {
        self.places.len()
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        let Place { local, by, tone } = &self.places[index];
        let mut model = self.locals.load(*local)?;
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

/// Decides which of `locals` take part in a merge. With `refines`, models are first moved to where they fit each other.
/// Then every model that contradicts others is kept out. `is_given_up` is called between models; if it returns true,
/// the result is an error.
pub fn admit<'a>(
    locals: &'a dyn Locals,
    refines: bool,
    threads: usize,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Admitted<'a>, MergeError> {
    let _span = info_span!("gate", models = locals.count()).entered();
    let count = locals.count();
    let Frames { moves, fits } = match refines {
        true => find_frames(locals, threads, is_given_up)?,
        false => Frames { moves: vec![None; count], fits: Vec::new() },
    };
    let place = |local: usize| Place { local, by: moves[local], tone: None };
    let mut admitted =
        Admitted { locals, doubts: vec![None; count], places: (0..count).map(place).collect(), fits };
    admitted.doubts = doubts_about(&admitted, threads, is_given_up)?;
    admitted.places = (0..count).filter(|i| admitted.doubts[*i].is_none()).map(place).collect();
    if let Some(tones) = tones(&admitted, threads, is_given_up)? {
        admitted.places.iter_mut().zip(tones).for_each(|(place, tone)| place.tone = Some(tone));
    }
    Ok(admitted)
}

/// The doubt about each of `locals`, by index. `is_given_up` is called between models; if it returns true, the result
/// is an error.
fn doubts_about(
    locals: &dyn Locals,
    threads: usize,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Vec<Option<Doubt>>, MergeError> {
    let go_on = || if is_given_up() { Err(MergeError::GivenUp) } else { Ok(()) };
    let mut shown = Vec::with_capacity(locals.count());
    for i in 0..locals.count() {
        go_on()?;
        shown.push(Shown::of(locals.load(i)?, locals.is_compressed(i), threads));
    }
    let mut relations = Relations::default();
    relations.note_distances(&shown);
    for judged in 0..shown.len() {
        go_on()?;
        relations.note_views(&shown, judged, locals, threads)?;
    }
    let unseen = |shown: &Shown| (shown.unseen > UNSEEN_MAX).then_some(Doubt::Unseen(shown.unseen));
    let mut doubts: Vec<Option<Doubt>> = shown.iter().map(unseen).collect();
    relations.doubt_contradicting(&shown, &mut doubts);
    Ok(doubts)
}

/// What the gate keeps of a model, to judge the model and to judge others by it.
struct Shown {
    cameras: Vec<Camera>,
    glimpses: Vec<Glimpse>,
    /// Share of the model's splats that none of its own cameras sees, 0..=1; 0 for a model without cameras.
    unseen: f64,
    /// Mean position of the cameras, world units.
    middle: DVec3,
    /// Distance from `middle` to the farthest camera, world units.
    radius: f64,
}

impl Shown {
    fn of(model: Model, is_compressed: bool, threads: usize) -> Self {
        let Model { splats, cameras } = model;
        let mut watchers = Watchers::new(&cameras);
        let is_unseen = |mean: &&[f32; 3]| {
            let mean = DVec3::from_array(mean.map(f64::from));
            !cameras.is_empty() && !watchers.any(mean, |_| true)
        };
        let unseen = splats.means.iter().filter(is_unseen).count() as f64 / splats.len().max(1) as f64;
        let glimpses = Glimpse::some(&splats, &cameras, is_compressed, threads);
        let middle = middle(&cameras);
        let radius = radius(&cameras, middle);
        Self { cameras, glimpses, unseen, middle, radius }
    }

    /// Gap between the cameras of the two models, in radii of the larger flight; negative if the flights overlap. A
    /// radius counts as at least 1 world unit.
    fn gap_radii(&self, other: &Self) -> f64 {
        let gap = self.middle.distance(other.middle) - self.radius - other.radius;
        gap / self.radius.max(other.radius).max(1.0)
    }
}

/// How many views confirm, and how many contradict, that two models show the same.
#[derive(Default)]
struct Relations {
    /// For each pair of models, lower index first: the number of views that confirm, and the number that contradict.
    views: BTreeMap<[usize; 2], [u32; 2]>,
}

impl Relations {
    fn note(&mut self, one: usize, other: usize, is_confirmed: bool, views: u32) {
        let pair = [one.min(other), one.max(other)];
        self.views.entry(pair).or_default()[usize::from(!is_confirmed)] += views;
    }

    /// For each flight: if even the nearest other flight is too far away, notes that the two contradict each other.
    fn note_distances(&mut self, shown: &[Shown]) {
        let flights: Vec<usize> = (0..shown.len()).filter(|i| !shown[*i].cameras.is_empty()).collect();
        for &one in &flights {
            let gap = |other: usize| shown[one].gap_radii(&shown[other]);
            let others = flights.iter().copied().filter(|other| *other != one);
            let nearest = others.min_by(|a, b| gap(*a).total_cmp(&gap(*b)));
            if let Some(nearest) = nearest.filter(|nearest| gap(*nearest) > GAP_MAX_RADII) {
                self.note(one, nearest, false, CONTRADICTIONS_MIN);
            }
        }
    }

    /// Compares model `judged` with the pictures of all other models, wherever its cameras see the same ground.
    fn note_views(
        &mut self,
        shown: &[Shown],
        judged: usize,
        locals: &dyn Locals,
        threads: usize,
    ) -> Result<(), MergeError> {
        let cameras = &shown[judged].cameras;
        let is_compressed = locals.is_compressed(judged);
        let mut renderer = None;
        for (other, its) in shown.iter().enumerate().filter(|(other, _)| *other != judged) {
            for glimpse in &its.glimpses {
                let Some(shared) = glimpse.shared_with(cameras) else { continue };
                let renderer = match &mut renderer {
                    Some(renderer) => renderer,
                    none => none.insert(Renderer::new(&locals.load(judged)?.splats, threads)),
                };
                if let Some(is_confirmed) = glimpse.is_confirmed_by(renderer, &shared, is_compressed) {
                    self.note(judged, other, is_confirmed, 1);
                }
            }
        }
        Ok(())
    }

    /// Indices of the models that contradict model `one`, and the number of models that confirm it. Skips doubted
    /// models.
    fn of(&self, one: usize, doubts: &[Option<Doubt>]) -> (Vec<usize>, usize) {
        let (mut foes, mut friends) = (Vec::new(), 0);
        for (pair, [confirmed, contradicted]) in &self.views {
            let other = match pair {
                [a, b] if *a == one => *b,
                [a, b] if *b == one => *a,
                _ => continue,
            };
            if doubts[other].is_some() {
                continue;
            }
            if contradicted > confirmed && *contradicted >= CONTRADICTIONS_MIN {
                foes.push(other);
            } else if confirmed > contradicted {
                friends += 1;
            }
        }
        (foes, friends)
    }

    /// Marks the worst model as doubtful, and repeats this until no two of the other models contradict each other.
    fn doubt_contradicting(&self, shown: &[Shown], doubts: &mut [Option<Doubt>]) {
        loop {
            let sound = (0..shown.len()).filter(|i| doubts[*i].is_none());
            let contradicting =
                sound.map(|i| (i, self.of(i, doubts))).filter(|(_, (foes, _))| !foes.is_empty());
            let badness = |i: usize, foes: usize, friends: usize| {
                (foes as isize - friends as isize, usize::MAX - shown[i].cameras.len(), i)
            };
            let worst = contradicting.max_by_key(|(i, (foes, friends))| badness(*i, foes.len(), *friends));
            let Some((worst, (foes, _))) = worst else { return };
            doubts[worst] = Some(Doubt::Contradicts(foes));
        }
    }
}
