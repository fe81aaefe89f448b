//! What is adjusted, and what it is adjusted to.

use std::ops::Range;

use glam::{DVec2, DVec3};

use super::super::lens::Lens;
use super::projection::{LENS, POSE, Station, project};

/// A mark so many standard deviations off has half of its weight (Cauchy's distribution; of marks without blunders it uses
/// 95 %, Holland and Welsch 1977).
const HALF_AT: f64 = 2.385;
/// What a point behind a camera costs: as much as a mark that is this many standard deviations off.
const BEHIND: f64 = 1e4;
/// Standard deviations of lenses about a lens without faults, by experience with cameras of drones: a factor on the focal
/// length that COLMAP found, the difference of both focal lengths as a share, the principal point as a share of the long
/// side, and the distortions. They hold what no photograph tells, and give way to what photographs tell.
const LENS_SIGMAS: LensSigmas =
    LensSigmas { focal_share: 0.2, aspect_share: 0.001, center_share: 0.03, radial: 0.5, tangential: 0.003 };

struct LensSigmas {
    focal_share: f64,
    aspect_share: f64,
    center_share: f64,
    radial: f64,
    tangential: f64,
}

/// The unknowns.
#[derive(Clone)]
pub(super) struct State {
    pub(super) stations: Vec<Station>,
    pub(super) lenses: Vec<Lens>,
    pub(super) points: Vec<DVec3>,
}

/// Where a photograph shows a point.
pub(super) struct Mark {
    pub(super) photograph: usize,
    pub(super) at_px: DVec2,
    /// Standard deviation, pixels.
    pub(super) sigma_px: f64,
}

/// A position that is known: of a camera or of a point.
#[derive(Clone, Copy)]
pub(super) struct Anchor {
    /// Index of the camera or of the point.
    pub(super) of: usize,
    pub(super) at_m: DVec3,
    /// Inverse variances along x, y and z, 1/m².
    pub(super) weight: DVec3,
}

/// A linear equation of the unknowns of a lens: `Σ factor · parameter = value`.
pub(super) struct LensEquation {
    pub(super) lens: usize,
    pub(super) factors: [f64; LENS],
    pub(super) value: f64,
    pub(super) weight: f64,
}

/// What is observed.
pub(super) struct Problem {
    /// Index of the lens of each photograph.
    pub(super) lens_of: Vec<usize>,
    /// In the order of points.
    pub(super) marks: Vec<Mark>,
    /// The marks of each point.
    pub(super) marks_of: Vec<Range<usize>>,
    pub(super) centers: Vec<Anchor>,
    /// In the order of points.
    pub(super) points: Vec<Anchor>,
    pub(super) lens_equations: Vec<LensEquation>,
    /// The first unknown of each photograph.
    pub(super) unknown_of: Vec<usize>,
}

impl Problem {
    /// Number of unknowns without those of points: poses first, then lenses.
    pub(super) fn unknowns(&self, state: &State) -> usize {
        self.unknown_of_lens(state.lenses.len())
    }

    /// The first unknown of a lens.
    pub(super) fn unknown_of_lens(&self, lens: usize) -> usize {
        POSE * self.lens_of.len() + LENS * lens
    }

    /// What remains of all observations: half of it is the negative logarithm of their likelihood.
    pub(super) fn cost(&self, state: &State) -> f64 {
        let marks = self.marks_of.iter().zip(&state.points).flat_map(|(marks, point)| {
            self.marks[marks.clone()].iter().map(|mark| {
                let lens = &state.lenses[self.lens_of[mark.photograph]];
                let seen = project(&state.stations[mark.photograph], lens, *point);
                let off = seen.map_or(BEHIND, |seen| (seen - mark.at_px).length() / mark.sigma_px);
                HALF_AT * HALF_AT * (off / HALF_AT).powi(2).ln_1p()
            })
        });
        let anchored =
            |anchor: &Anchor, at: DVec3| ((at - anchor.at_m).powf(2.0) * anchor.weight).element_sum();
        let centers = self.centers.iter().map(|anchor| anchored(anchor, state.stations[anchor.of].center));
        let points = self.points.iter().map(|anchor| anchored(anchor, state.points[anchor.of]));
        let lenses = self
            .lens_equations
            .iter()
            .map(|equation| equation.off(&state.lenses[equation.lens]).powi(2) * equation.weight);
        marks.chain(centers).chain(points).chain(lenses).sum()
    }
}

impl Mark {
    /// How much the mark counts if it is so many pixels off, 1/px².
    pub(super) fn weight(&self, off_px: DVec2) -> f64 {
        let variance = self.sigma_px * self.sigma_px;
        1.0 / (variance + off_px.length_squared() / (HALF_AT * HALF_AT))
    }
}

impl LensEquation {
    /// What a lens is like as far as no photograph tells.
    pub(super) fn of(index: usize, lens: &Lens) -> Vec<Self> {
        let its = LENS_SIGMAS;
        let [width, height] = lens.size_px.map(f64::from);
        let focal = lens.focal_px.element_sum() / 2.0;
        let center = its.center_share * width.max(height);
        let unit = |at: usize| std::array::from_fn(|i| if i == at { 1.0 } else { 0.0 });
        let [fx, fy] = lens.focal_px.to_array();
        // Of stretched pictures, COLMAP finds the aspect well.
        let stretched = if lens.fault().is_some() { fx - fy } else { 0.0 };
        let aspect = [1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        [
            (unit(0), focal, its.focal_share * focal),
            (aspect, stretched, its.aspect_share * focal),
            (unit(2), width / 2.0, center),
            (unit(3), height / 2.0, center),
            (unit(4), 0.0, its.radial),
            (unit(5), 0.0, its.radial),
            (unit(6), 0.0, its.tangential),
            (unit(7), 0.0, its.tangential),
        ]
        .map(|(factors, value, sigma)| Self { lens: index, factors, value, weight: sigma.powi(-2) })
        .into()
    }

    /// How far a lens is from fulfilling it.
    pub(super) fn off(&self, lens: &Lens) -> f64 {
        let parameters = lens.parameters();
        self.factors.iter().zip(parameters).map(|(factor, its)| factor * its).sum::<f64>() - self.value
    }
}
