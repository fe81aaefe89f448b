//! Decides which models take part in a merge. A model that contradicts others stays on the disk, but is kept out of
//! merges until it contradicts no other model.
//!
//! The gate renders small pictures of each model from some of its cameras. If the cameras of another model see the
//! same ground, the other model must give the same pictures ([`glimpse`]). A forged model does not, nor does a model
//! in another frame or scale. The gate also keeps out a model that does not fit its own cameras: most of its splats lie
//! where none of them looks, or most of their pictures show no surface. It keeps out a model so far from all others that
//! its origin must be wrong, and one that shows shared ground far worse than the others do ([`quality`]).
//!
//! A model that shares no ground with the others cannot be verified: its frame may be another one. It is accepted only if
//! the frames of all models are vouched for.
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
mod quality;
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
use crate::merge::{Locals, MergeError, MergeSettings};
pub use frames::{Fit, Move};
use frames::{Placement, find_frames, groups};
use glimpse::Glimpse;
use quality::{Detail, Differences, Standard};
pub use similarity::Similarity;
pub use tone::Tone;
use tone::tones;

/// Largest accepted share of a model's splats that none of its own cameras sees. Trained models stay far below it.
const UNSEEN_MAX: f64 = 0.5;
/// Largest gap between two flights (the cameras of two models) that can have the same origin, in radii of the larger
/// flight.
const GAP_MAX_RADII: f64 = 20.0;
/// Share of a picture that must show a surface. Pictures of trained models show a surface almost everywhere.
const SHOWN_MIN: f64 = 0.1;
/// Two models contradict each other only if at least this many views contradict, and more views contradict than
/// confirm.
const CONTRADICTIONS_MIN: u32 = 2;

/// Why a model is kept out of a merge.
#[derive(Clone, Debug, PartialEq)]
pub enum Doubt {
    /// This share of the model's splats, 0..=1, lies where none of its own cameras looks.
    Unseen(f64),
    /// This share of the pictures of the model's own cameras, 0..=1, shows mostly no surface.
    Void(f64),
    /// The model contradicts the models with these indices.
    Contradicts(Vec<usize>),
    /// The model's error on ground that it shares with others is this many times as large as theirs.
    FarWorse(f64),
    /// The model shares no ground with the others, and its frame is not vouched for.
    Unverified,
}

impl Doubt {
    /// The reason as a sentence without its subject. `names` has the name of every model.
    pub(crate) fn reason<N: AsRef<str>>(&self, names: &[N]) -> String {
        match self {
            Self::Unseen(share) => {
                format!("has {:.0} % of its splats where none of its cameras looks", 100.0 * share)
            }
            Self::Void(share) => {
                format!("shows no ground in {:.0} % of the pictures of its own cameras", 100.0 * share)
            }
            Self::FarWorse(times) => {
                format!("shows shared ground far worse than the others ({times:.0} times their error)")
            }
            Self::Unverified => {
                "shares no ground with the others, so it may be in another frame; name the frame if it is the same".into()
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
    /// What the model's observations count, 0..=1: 1, or less if it differs from the others more than they do.
    pub weight: f64,
    /// Whether the model shares ground with others, so that its place is verified. A model alone counts as verified.
    pub is_verified: bool,
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
        let Place { local, by, tone, .. } = &self.places[index];
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

    fn weight(&self, index: usize) -> f64 {
        self.places[index].weight
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
    /// Whether all models are known to lie in one frame. Then a model that shares no ground with the others is accepted.
    pub vouched: bool,
}

impl From<&MergeSettings> for Frames {
    fn from(&MergeSettings { refine, vouched, .. }: &MergeSettings) -> Self {
        Self { refine, vouched }
    }
}

/// Decides which of `locals` take part in a merge. If told so, first moves models to where they fit each other.
/// Then every model that contradicts others is kept out. `is_given_up` is called between models; if it returns true,
/// the result is an error.
pub fn admit<'a>(
    locals: &'a dyn Locals,
    frames: Frames,
    threads: usize,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Admitted<'a>, MergeError> {
    let _span = info_span!("gate", models = locals.count()).entered();
    let count = locals.count();
    let Placement { moves, fits } = match frames.refine {
        true => find_frames(locals, threads, is_given_up)?,
        false => Placement { moves: vec![None; count], fits: Vec::new() },
    };
    let place = |local: usize| Place { local, weight: 1.0, is_verified: true, by: moves[local], tone: None };
    let mut admitted =
        Admitted { locals, doubts: vec![None; count], places: (0..count).map(place).collect(), fits };
    let linked: Vec<[usize; 2]> = admitted.fits.iter().map(|fit| fit.models).collect();
    let judged = judge(&admitted, &linked, threads, is_given_up)?;
    let accepted =
        |local: &usize| judged[*local].doubt.is_none() && (frames.vouched || judged[*local].is_verified);
    let place = |local: usize| {
        let Judged { weight, is_verified, .. } = judged[local];
        Place { weight, is_verified, ..place(local) }
    };
    admitted.places = (0..count).filter(accepted).map(place).collect();
    let unverified = |local: usize| (!accepted(&local)).then_some(Doubt::Unverified);
    admitted.doubts =
        (0..count).map(|local| judged[local].doubt.clone().or_else(|| unverified(local))).collect();
    if let Some(tones) = tones(&admitted, threads, is_given_up)? {
        admitted.places.iter_mut().zip(tones).for_each(|(place, tone)| place.tone = Some(tone));
    }
    Ok(admitted)
}

/// What the gate thinks of a model.
struct Judged {
    doubt: Option<Doubt>,
    /// See [`Place::weight`] and [`Place::is_verified`].
    weight: f64,
    is_verified: bool,
}

/// Judges each of `locals`, by index. Models that are `linked` share ground. `is_given_up` is called between models; if
/// it returns true, the result is an error.
fn judge(
    locals: &dyn Locals,
    linked: &[[usize; 2]],
    threads: usize,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Vec<Judged>, MergeError> {
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
    let mut doubts: Vec<Option<Doubt>> = shown.iter().map(Shown::doubt).collect();
    relations.doubt_contradicting(&shown, &mut doubts);
    let standards = relations.differences.standards(shown.len(), |i| doubts[i].is_none());
    let far_worse = |standard: &Standard| standard.is_far_worse().then_some(Doubt::FarWorse(standard.times));
    doubts
        .iter_mut()
        .zip(&standards)
        .for_each(|(doubt, standard)| *doubt = doubt.take().or(far_worse(standard)));
    let verified = relations.verified(linked, &shown, &doubts);
    let judged = doubts.into_iter().zip(standards).zip(verified);
    Ok(judged
        .map(|((doubt, standard), is_verified)| Judged { doubt, weight: standard.weight(), is_verified })
        .collect())
}

/// What the gate keeps of a model, to judge the model and to judge others by it.
struct Shown {
    cameras: Vec<Camera>,
    glimpses: Vec<Glimpse>,
    /// The detail of each glimpse.
    details: Vec<Detail>,
    /// Share of the model's splats that none of its own cameras sees, 0..=1; 0 for a model without cameras.
    unseen: f64,
    /// Share of the glimpses that show mostly no surface, 0..=1; 0 for a model that was pruned before upload.
    void: f64,
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
        let mut renderer = Renderer::new(&splats, threads);
        let details = glimpses.iter().map(|glimpse| Detail::of(&mut renderer, glimpse.camera())).collect();
        let is_void = |glimpse: &&Glimpse| !is_compressed && glimpse.shown() < SHOWN_MIN;
        let void = glimpses.iter().filter(is_void).count() as f64 / glimpses.len().max(1) as f64;
        let middle = middle(&cameras);
        let radius = radius(&cameras, middle);
        Self { cameras, glimpses, details, unseen, void, middle, radius }
    }

    /// Whether the model does not fit its own cameras.
    fn doubt(&self) -> Option<Doubt> {
        if self.unseen > UNSEEN_MAX {
            return Some(Doubt::Unseen(self.unseen));
        }
        (self.void >= 0.5).then_some(Doubt::Void(self.void))
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
    /// How much the detail of the models differs.
    differences: Differences,
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
            for (glimpse, there) in its.glimpses.iter().zip(&its.details) {
                let Some(shared) = glimpse.shared_with(cameras) else { continue };
                let renderer = match &mut renderer {
                    Some(renderer) => renderer,
                    none => none.insert(Renderer::new(&locals.load(judged)?.splats, threads)),
                };
                // A model that was pruned before upload differs because of what it lacks.
                if !is_compressed && !locals.is_compressed(other) {
                    let detail = Detail::of(renderer, glimpse.camera());
                    let difference = detail.difference(there, &shared, glimpse.camera().size_px);
                    difference.into_iter().for_each(|found| self.differences.note(judged, other, found));
                }
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

    /// Whether each model belongs to the largest group of models that share ground, directly or by way of others. Of
    /// equally large groups, that with more cameras counts, then that with the lowest index. Skips doubted models.
    fn verified(&self, linked: &[[usize; 2]], shown: &[Shown], doubts: &[Option<Doubt>]) -> Vec<bool> {
        let confirmed = self.views.iter().filter(|(_, [confirmed, contradicted])| confirmed > contradicted);
        let pairs = linked.iter().chain(confirmed.map(|(pair, _)| pair)).copied();
        let groups = groups(pairs.filter(|pair| pair.iter().all(|i| doubts[*i].is_none())), shown.len());
        let size = |group: usize| {
            let of_group = || (0..shown.len()).filter(|i| groups[*i] == group);
            let cameras: usize = of_group().map(|i| shown[i].cameras.len()).sum();
            (of_group().count(), cameras, usize::MAX - group)
        };
        let sound = (0..shown.len()).filter(|i| doubts[*i].is_none());
        let largest = sound.map(|i| groups[i]).max_by_key(|group| size(*group));
        groups.iter().map(|group| Some(*group) == largest).collect()
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
