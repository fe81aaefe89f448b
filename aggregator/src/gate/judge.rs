//! Compares models with each other and with their own cameras, and decides which of them can be trusted.

use std::collections::BTreeMap;
use std::path::Path;

use cosurf_engine::compress::{Density, shown_min};
use cosurf_engine::{Renderer, Trust};
use cosurf_link::Model;
use cosurf_scene::{Camera, SceneError, Watchers};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::chosen::Chooser;
use super::claims::Claims;
use super::doubt::Doubt;
use super::evenness::{Evenness, blocks};
use super::frames::groups;
use super::glimpse::{Glimpse, VIEWS, median};
use super::quality::{Detail, Differences, Standard};
use super::sharpness::{Fine, Granted, Sharpness, Told, are_wide_enough, window};
use super::tone::{Pairs, contrast};
use crate::merge::cameras::{middle, radius};
use crate::merge::shifts::Shifts;
use crate::merge::{Locals, MergeError};
use crate::scratch::{Record, Records};

/// Largest accepted share of a model's splats that none of its own cameras sees. Trained models stay far below it.
const UNSEEN_MAX: f64 = 0.5;
/// Largest accepted coefficient of colour. Trained ones stay below 10. One splat with 10,000 made the gate believe that all
/// other models are too dark, and cost rendered Boruszyn 5.4 dB.
const SH_MAX: f32 = 64.0;
/// Largest gap between two flights (the cameras of two models) that can have the same origin, in radii of the larger
/// flight.
const GAP_MAX_RADII: f64 = 20.0;
/// Share of a picture that must show a surface. Pictures of trained models show a surface almost everywhere.
const SHOWN_MIN: f64 = 0.1;
/// A model is a witness of the size of pixels if at least this share of its views shows as much surface as views of other
/// models do ([`shown_min`]). Of honest models, all views do.
const WITNESS_SHARE_MIN: f64 = 0.8;
/// The error of a model is measured where the splats of both compared models lie at least this many times as densely as is
/// usual in the model. Elsewhere, few cameras of one of them looked: there, honest models differ more from each other than
/// spoilt ones do elsewhere.
const DENSE_MIN: f64 = 0.8;
/// In fewer pixels, the error is not measured.
const DENSE_PX_MIN: usize = 64;
/// Largest number of places in a view at which the models say how finely they saw it.
const PLACES_MAX: usize = 32;
/// Two models contradict each other only if at least this many views contradict, and more views contradict than
/// confirm.
const CONTRADICTIONS_MIN: u32 = 2;

/// What the gate thinks of all models.
pub(super) struct Judgement {
    /// One entry for each model.
    pub(super) judged: Vec<Judged>,
    /// The colours in which each pair of models shows the same surface.
    pub(super) colors: Pairs,
}

/// What the gate thinks of a model.
pub(super) struct Judged {
    pub(super) doubt: Option<Doubt>,
    /// How far the model's observations are believed.
    pub(super) trust: Trust,
    /// Factor on the sides of the model's pictures, 0..=1: below 1 if they show less detail than they claim.
    pub(super) size: f64,
    /// Whether the model belongs to the largest group of models that share ground with each other.
    pub(super) is_verified: bool,
    /// Share of the pictures of the model's own cameras that show hardly any surface, 0..=1.
    pub(super) void: f64,
    /// Whether the model has no cameras.
    pub(super) is_blind: bool,
}

/// Judges each of `locals`, by index, in pictures that `choosers` choose. Models that are `linked` share ground.
/// `is_given_up` is called between models; if it returns true, the result is an error.
pub(super) fn judge(
    locals: &dyn Locals,
    choosers: &[Chooser],
    linked: &[[usize; 2]],
    shifts: Shifts,
    scratch: &Path,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Judgement, MergeError> {
    let mut records = Records::new(scratch)?;
    let mut shown = Vec::with_capacity(locals.count());
    let look = |(): &mut (), i: usize| {
        let model = locals.load(i)?;
        Ok(Shown::of(model, &choosers[i], locals.is_compressed(i), shifts.threads))
    };
    shifts.run(locals.count(), is_given_up, look, |_, (mut its, views): (Shown, Vec<View>)| {
        its.views = views.iter().map(|view| view.put(&mut records)).collect::<Result<_, _>>()?;
        shown.push(its);
        Ok(())
    })?;
    let mut relations = Relations::default();
    relations.note_distances(&shown);
    let compare = |(): &mut (), judged: usize| compare(&shown, judged, locals, shifts.threads, &records);
    shifts.run(shown.len(), is_given_up, compare, |judged, compared: Vec<Compared>| {
        compared.into_iter().for_each(|its| relations.note_view(judged, its));
        Ok(())
    })?;
    let (doubts, standards) = relations.verdict(&shown);
    let verified = relations.verified(linked, &shown, &doubts);
    let granted = relations.granted(&doubts, &witnesses(&shown));
    let of_colors = relations.evenness.differences().standards(shown.len(), |i| doubts[i].is_none());
    let weight = |i: usize| standards[i].weight() * of_colors[i].weight();
    let judged = doubts.into_iter().enumerate().map(|(i, doubt)| Judged {
        doubt,
        trust: Trust { weight: weight(i), pixels_max: granted[i].pixels_max },
        size: granted[i].size,
        is_verified: verified[i],
        void: shown[i].void(),
        is_blind: shown[i].cameras.is_empty(),
    });
    Ok(Judgement { judged: judged.collect(), colors: relations.colors })
}

/// What the gate keeps of a model, to judge the model and to judge others by it.
struct Shown {
    cameras: Vec<Camera>,
    is_empty: bool,
    /// The largest absolute coefficient of the splats' colours.
    sh_max: f32,
    /// Views from some of these cameras, in a file.
    views: Vec<ViewRecord>,
    /// Share of the model's splats that none of its own cameras sees, 0..=1; 0 for a model without cameras.
    unseen: f64,
    /// Share of each view that shows a surface, 0..=1; none for a model that was pruned before upload.
    solid: Vec<f64>,
    /// How densely the splats lie; `None` if no view shows ground.
    density: Option<Density>,
    /// Mean position of the cameras, world units.
    middle: DVec3,
    /// Distance from `middle` to the farthest camera, world units.
    radius: f64,
}

/// Where a view lies in the file.
struct ViewRecord {
    record: Record,
    /// Centre and radius of a ball around the surface in the view.
    ball: (DVec3, f64),
}

/// A view from one of a model's own cameras.
#[derive(Serialize, Deserialize)]
struct View {
    camera: Camera,
    glimpse: Glimpse,
    /// `None` for a model that was pruned before upload: what it lacks would count as an error.
    detail: Option<Detail>,
    fine: Option<Fine>,
}

impl View {
    fn put(&self, records: &mut Records) -> Result<ViewRecord, SceneError> {
        Ok(ViewRecord { record: records.put(self)?, ball: self.glimpse.ball() })
    }

    /// How the model of `renderer` compares with the model `other`, of which this is a view, at the `shared` pixels of
    /// the glimpse. Of these, both models lie densely at the `dense` ones. `claims` has what the cameras of the model of
    /// `renderer` and those of the other one claim.
    fn compared(
        &self,
        other: usize,
        renderer: &mut Renderer,
        [shared, dense]: [&[usize]; 2],
        is_compressed: bool,
        claims: [&Claims; 2],
    ) -> Compared {
        let Self { camera, glimpse, detail, fine } = self;
        let shown = Glimpse::of(renderer, camera, is_compressed);
        let is_confirmed = glimpse.is_confirmed_by(&shown, shared, is_compressed);
        let mut compared = Compared {
            other,
            is_confirmed,
            difference: None,
            colors: Vec::new(),
            blocks: Vec::new(),
            told: None,
        };
        if !is_compressed && let (Some(detail), Some(fine)) = (detail, fine) {
            let same: Vec<_> = glimpse.colors_with(&shown, shared).collect();
            compared.colors = same.iter().map(|(_, colors)| *colors).collect();
            compared.blocks = blocks(same.into_iter());
            // Another camera's contrast is neither an error nor a lack of detail.
            let contrast = contrast(&compared.colors);
            if dense.len() >= DENSE_PX_MIN {
                let own = Detail::of(renderer, camera).times(contrast);
                compared.difference = own.difference(detail, dense, glimpse.size_px());
            }
            compared.told = self.claimed(shared, claims).and_then(|claimed| {
                let log_ratio = Fine::of(renderer, camera).log_ratio(fine)? + 2.0 * libm::log(contrast);
                Some(Told { log_ratio, claimed })
            });
        }
        compared
    }

    /// Number of pixels on a square of one world unit that the cameras of two models claim in the part of the view where
    /// their finest detail is compared. `None` if the view does not tell whether the first claim is right.
    fn claimed(&self, shared: &[usize], [its, of_other]: [&Claims; 2]) -> Option<[f64; 2]> {
        let window = window(&self.camera);
        let places = shared.iter().map(|i| self.glimpse.point(*i)).filter(|place| window.sees(*place));
        let places: Vec<DVec3> = places.collect();
        let step = places.len().div_ceil(PLACES_MAX).max(1);
        let places: Vec<DVec3> = places.into_iter().step_by(step).collect();
        let of_view = Claims::new(&[self.camera]).pixels(&places)?;
        let claimed = [its.pixels(&places)?, of_other.pixels(&places)?];
        are_wide_enough([of_view, claimed[0]]).then_some(claimed)
    }
}

impl Shown {
    /// Also returns the views, which are not yet in a file.
    fn of(model: Model, chooser: &Chooser, is_compressed: bool, threads: usize) -> (Self, Vec<View>) {
        let Model { splats, cameras } = model;
        let mut watchers = Watchers::new(&cameras);
        let is_unseen = |mean: &&[f32; 3]| {
            let mean = DVec3::from_array(mean.map(f64::from));
            !cameras.is_empty() && !watchers.any(mean, |_| true)
        };
        let unseen = splats.means.iter().filter(is_unseen).count() as f64 / splats.len().max(1) as f64;
        let mut renderer = Renderer::new(&splats, threads);
        let (mut views, mut pixels, mut solid) = (Vec::new(), Vec::new(), Vec::new());
        for camera in &chooser.choose(&cameras, VIEWS) {
            let glimpse = Glimpse::of(&mut renderer, camera, is_compressed);
            let detail = (!is_compressed).then(|| Detail::of(&mut renderer, camera));
            let fine = (!is_compressed).then(|| Fine::of(&mut renderer, camera));
            solid.extend((!is_compressed).then(|| glimpse.shown()));
            pixels
                .extend(glimpse.median_depth().map(|depth| depth / camera.focal_px.element_product().sqrt()));
            views.push(View { camera: *camera, glimpse, detail, fine });
        }
        let density = (!pixels.is_empty()).then(|| Density::of(&splats, median(&mut pixels)));
        let middle = middle(&cameras);
        let radius = radius(&cameras, middle);
        let is_empty = splats.is_empty();
        let sh_max = splats.sh.iter().fold(0.0, |most: f32, value| most.max(value.abs()));
        let shown =
            Self { cameras, is_empty, sh_max, views: Vec::new(), unseen, solid, density, middle, radius };
        (shown, views)
    }

    /// Share of the views that show hardly any surface, 0..=1.
    fn void(&self) -> f64 {
        let void = self.solid.iter().filter(|share| **share < SHOWN_MIN).count();
        void as f64 / self.solid.len().max(1) as f64
    }

    /// Whether the model does not fit its own cameras.
    fn doubt(&self) -> Option<Doubt> {
        if self.is_empty {
            return Some(Doubt::Empty);
        }
        if self.sh_max >= SH_MAX {
            return Some(Doubt::Glaring(f64::from(self.sh_max)));
        }
        if self.unseen > UNSEEN_MAX {
            return Some(Doubt::Unseen(self.unseen));
        }
        let void = self.void();
        (void >= 0.5).then_some(Doubt::Void(void))
    }

    /// Whether the splats lie densely at `place`.
    fn is_dense(&self, place: DVec3) -> bool {
        self.density.as_ref().is_none_or(|density| density.at(place) >= DENSE_MIN)
    }

    /// Gap between the cameras of the two models, in radii of the larger flight; negative if the flights overlap. A
    /// radius counts as at least 1 world unit.
    fn gap_radii(&self, other: &Self) -> f64 {
        let gap = self.middle.distance(other.middle) - self.radius - other.radius;
        gap / self.radius.max(other.radius).max(1.0)
    }
}

/// For each model: whether its cameras can tell how large the pixels of others are. Cameras that look elsewhere than the
/// model's pictures were taken claim other distances: the city's with inverted poses made the right model, of which they
/// had a copy, count as pictures 81 % as large, which cost 0.12 dB.
fn witnesses(shown: &[Shown]) -> Vec<bool> {
    let least = shown_min(shown.iter().map(|its| &its.solid[..]));
    let is_witness = |its: &Shown| {
        let solid = its.solid.iter().filter(|share| **share >= least).count();
        solid as f64 >= WITNESS_SHARE_MIN * its.solid.len() as f64
    };
    shown.iter().map(is_witness).collect()
}

/// How a model compares with another one in a view of the other one.
struct Compared {
    other: usize,
    /// Whether both show the same; `None` if that cannot be decided.
    is_confirmed: Option<bool>,
    /// How much their detail differs.
    difference: Option<f64>,
    /// Colours of the surface that both show: those of the other model, then those of this model.
    colors: Vec<[[f32; 3]; 2]>,
    /// The means of these colours in blocks of pixels.
    blocks: Vec<[[f64; 3]; 2]>,
    /// How much finer the detail of the model is, and what both claim.
    told: Option<Told>,
}

/// Compares model `judged` with the pictures of all other models, wherever its cameras see the same ground.
fn compare(
    shown: &[Shown],
    judged: usize,
    locals: &dyn Locals,
    threads: usize,
    records: &Records,
) -> Result<Vec<Compared>, MergeError> {
    let cameras = &shown[judged].cameras;
    let claims = Claims::new(cameras);
    let is_near = |view: &&ViewRecord| claims.touches(view.ball.0, view.ball.1);
    let is_compressed = locals.is_compressed(judged);
    let (mut renderer, mut found) = (None, Vec::new());
    for (other, its) in shown.iter().enumerate().filter(|(other, _)| *other != judged) {
        let of_other = Claims::new(&its.cameras);
        for view in its.views.iter().filter(is_near) {
            let view: View = records.get(view.record)?;
            let Some(shared) = view.glimpse.shared_with(cameras) else { continue };
            let renderer = match &mut renderer {
                Some(renderer) => renderer,
                none => none.insert(Renderer::new(&locals.load(judged)?.splats, threads)),
            };
            let is_dense = |i: &usize| {
                let place = view.glimpse.point(*i);
                its.is_dense(place) && shown[judged].is_dense(place)
            };
            let dense: Vec<usize> = shared.iter().copied().filter(is_dense).collect();
            let claims = [&claims, &of_other];
            found.push(view.compared(other, renderer, [&shared, &dense], is_compressed, claims));
        }
    }
    Ok(found)
}

/// How many views confirm, and how many contradict, that two models show the same.
#[derive(Default)]
struct Relations {
    /// For each pair of models, lower index first: the number of views that confirm, and the number that contradict.
    views: BTreeMap<[usize; 2], [u32; 2]>,
    /// How much the detail of the models differs.
    differences: Differences,
    /// How much finer the detail of some models is than that of others.
    sharpness: Sharpness,
    /// The colours in which each pair of models shows the same surface. Models pruned before upload are left out: they
    /// share with other models only ground that neither model shows well.
    colors: Pairs,
    /// Whether these colours differ by the same everywhere.
    evenness: Evenness,
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

    /// Notes how model `judged` compares with another one in a view.
    fn note_view(&mut self, judged: usize, compared: Compared) {
        let Compared { other, is_confirmed, difference, colors, blocks, told } = compared;
        is_confirmed.into_iter().for_each(|is_confirmed| self.note(judged, other, is_confirmed, 1));
        difference.into_iter().for_each(|found| self.differences.note(judged, other, found));
        self.colors.note(other, judged, colors.into_iter());
        self.evenness.note(other, judged, &blocks);
        told.into_iter().for_each(|told| self.sharpness.note(judged, other, told));
    }

    /// What is granted to each model. For witnesses, it is found without the others.
    fn granted(&self, doubts: &[Option<Doubt>], witnesses: &[bool]) -> Vec<Granted> {
        let count = witnesses.len();
        let of_all = self.sharpness.granted(count, |i| doubts[i].is_none());
        let of_witnesses = self.sharpness.granted(count, |i| doubts[i].is_none() && witnesses[i]);
        let chosen = |i: usize| if witnesses[i] { of_witnesses[i] } else { of_all[i] };
        (0..count).map(chosen).collect()
    }

    /// The doubt about each model, and how well each shows the ground that it shares with others. A model that is far
    /// worse than the others is not asked which models contradict it: it may contradict a good one.
    fn verdict(&self, shown: &[Shown]) -> (Vec<Option<Doubt>>, Vec<Standard>) {
        let mut known: Vec<Option<Doubt>> = shown.iter().map(Shown::doubt).collect();
        loop {
            let mut doubts = known.clone();
            self.doubt_contradicting(shown, &mut doubts);
            let standards = self.differences.standards(shown.len(), |i| doubts[i].is_none());
            let is_new =
                |i: &usize| known[*i].is_none() && doubts[*i].is_none() && standards[*i].is_far_worse();
            let far_worse: Vec<usize> = (0..shown.len()).filter(is_new).collect();
            if far_worse.is_empty() {
                return (doubts, standards);
            }
            far_worse.iter().for_each(|i| known[*i] = Some(Doubt::FarWorse(standards[*i].times)));
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::above;

    /// What the gate keeps of a model with some cameras.
    fn shown(cameras: usize) -> Shown {
        let cameras = vec![above(0.0); cameras];
        Shown {
            cameras,
            is_empty: false,
            sh_max: 2.0,
            views: Vec::new(),
            unseen: 0.0,
            solid: vec![1.0; 8],
            density: None,
            middle: DVec3::ZERO,
            radius: 1.0,
        }
    }

    #[test]
    fn a_far_worse_model_does_not_throw_out_a_good_one_that_it_contradicts() {
        let models = [shown(9), shown(9), shown(5), shown(20)];
        let with = |error_of_last: f64| {
            let mut relations = Relations::default();
            for (one, other) in [(0, 1), (0, 2), (1, 2)] {
                relations.note(one, other, true, 6);
                relations.differences.note(one, other, 0.1);
            }
            for one in 0..2 {
                relations.note(one, 3, true, 6);
                relations.differences.note(one, 3, 0.05 + error_of_last);
            }
            relations.note(2, 3, false, 6);
            relations.verdict(&models).0
        };
        let doubts = with(4.0);
        assert!(doubts[..3].iter().all(Option::is_none), "{doubts:?}");
        assert!(matches!(doubts[3], Some(Doubt::FarWorse(times)) if times > 20.0), "{doubts:?}");
        // Of two good models that contradict each other, the one with fewer cameras is dropped.
        assert_eq!(with(0.05), [None, None, Some(Doubt::Contradicts(vec![3])), None]);
    }

    /// An honest model, and a copy of it with cameras elsewhere, which claim wider or finer pixels.
    #[test]
    fn cameras_that_look_elsewhere_make_only_their_own_model_small() {
        let mut models = [shown(9), shown(9)];
        models[1].solid = vec![1.0, 0.4, 1.0, 0.3, 0.9, 0.4, 1.0, 1.0];
        let seen = witnesses(&models);
        assert_eq!(seen, [true, false]);
        let with = |pixel_m: f64, witnesses: &[bool]| {
            let mut relations = Relations::default();
            let told = Told { log_ratio: 0.0, claimed: [100.0, pixel_m.powi(-2)] };
            (0..8).for_each(|_| relations.sharpness.note(0, 1, told));
            let granted = relations.granted(&[None, None], witnesses);
            granted.into_iter().map(|its| its.size).collect::<Vec<f64>>()
        };
        assert!(with(0.4, &[true; 2])[0] < 0.6, "as a witness, it makes the honest model small");
        assert_eq!(with(0.4, &seen)[0], 1.0);
        let sizes = with(0.025, &seen);
        assert!(sizes[0] == 1.0 && sizes[1] < 0.6, "{sizes:?}");
    }
}
