//! Least squares in which places that disagree lose their weight.

use glam::{DQuat, DVec3};

use super::normal::{Normal, Row};
use super::observation::{Sighting, median};
use super::up::Up;
use crate::error::GeoError;
use crate::georeference::FitUncertainty;
use crate::similarity::Similarity;

/// Rounds of weights and steps; a fit settles within ten.
const ROUNDS: usize = 40;
/// So many independent observations the GPS of a flight is worth, however many photographs it has: its errors drift slowly.
/// An estimate, from flights of consumer drones of ten minutes.
const GPS_WORTH: f64 = 4.0;
/// A residual of so many standard deviations has a quarter of its weight (Geman and McClure 1985).
const QUARTER_AT: f64 = 3.0;
/// A place agrees within so many standard deviations.
const AGREES_WITHIN: f64 = 4.0;
/// Fewest places of a kind that tell how accurate their kind is: one of them can be wrong.
pub(super) const JUDGED_MIN: usize = 4;
/// The standard deviation of the height where nothing tells it, metres.
const UNKNOWN_HEIGHT_M: f64 = 1000.0;
/// Of a normal distribution: the standard deviation for each median of the size of a residual.
const SIGMA_PER_MEDIAN: f64 = 1.4826;
/// The same for the length of a residual in two dimensions (Rayleigh): 1 / sqrt(2 ln 2).
const SIGMA_PER_MEDIAN_2D: f64 = 0.8493;

/// A refined similarity.
pub(super) struct Refined {
    pub(super) similarity: Similarity,
    /// Of GPS and of control points.
    pub(super) spreads: [Spread; 2],
    pub(super) uncertainty: FitUncertainty,
}

/// Standard deviations of places, by their residuals.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spread {
    /// Of places that do not tell their own: in each of east and north, and vertical, metres.
    untold_m: [f64; 2],
    /// How many times as large as they tell, at least 1, the errors are of places that tell their own; `None` if there are
    /// too few to judge, and they are taken as the others.
    told: Option<[f64; 2]>,
}

impl Spread {
    fn of(places: &[Sighting], similarity: &Similarity) -> Self {
        let (told, untold): (Vec<&Sighting>, Vec<&Sighting>) = places.iter().partition(|place| place.is_told);
        let judged = told.len() >= JUDGED_MIN;
        // A few that do not tell must not judge themselves: all judge them.
        let others = if judged && untold.len() >= JUDGED_MIN { untold } else { places.iter().collect() };
        let told =
            judged.then(|| scatter(&told, similarity, |place| place.sigma_m).map(|times| times.max(1.0)));
        Self { untold_m: scatter(&others, similarity, |_| [1.0; 2]), told }
    }

    /// Whether enough places tell their own, and have errors of at most so many times that.
    pub(super) fn believes(&self, times: f64) -> bool {
        self.told.is_some_and(|[horizontal, _]| horizontal <= times)
    }

    /// Standard deviations of one place: horizontal and vertical, metres.
    fn sigmas(&self, place: &Sighting) -> [f64; 2] {
        let of = |axis: usize| match self.told {
            Some(told) if place.is_told => told[axis] * place.sigma_m[axis],
            _ => self.untold_m[axis].max(place.sigma_m[axis]),
        };
        [of(0), of(1)]
    }

    /// Whether a place agrees with most of the others.
    pub(super) fn holds(&self, similarity: &Similarity, place: &Sighting) -> bool {
        let off = place.residual(similarity);
        let [horizontal_m, vertical_m] = self.sigmas(place);
        off.truncate().length() <= AGREES_WITHIN * horizontal_m && off.z.abs() <= AGREES_WITHIN * vertical_m
    }

    /// What a place is worth: inverse variances along east, north and up, 1/m². `worth` is that of one that agrees.
    pub(super) fn weight(&self, similarity: &Similarity, place: &Sighting, worth: f64) -> DVec3 {
        let off = place.residual(similarity);
        let [horizontal_m, vertical_m] = self.sigmas(place);
        // A place that is wrong in the plane has no good height either.
        let trust = worth * weight(off.truncate().length() / horizontal_m);
        let horizontal = trust / (horizontal_m * horizontal_m);
        let vertical = trust * weight(off.z / vertical_m) / (vertical_m * vertical_m);
        DVec3::new(horizontal, horizontal, if place.has_height { vertical } else { 0.0 })
    }
}

/// Standard deviations of the residuals of places, horizontal and vertical. Each residual is divided by what `unit_m` tells of
/// its place first.
fn scatter(places: &[&Sighting], similarity: &Similarity, unit_m: fn(&Sighting) -> [f64; 2]) -> [f64; 2] {
    let off = |place: &Sighting| place.residual(similarity);
    let horizontal = places.iter().map(|place| off(place).truncate().length() / unit_m(place)[0]);
    let vertical = places.iter().filter(|place| place.has_height);
    let vertical = vertical.map(|place| off(place).z.abs() / unit_m(place)[1]);
    // A fit of few places swallows a part of their errors: each takes two of their degrees of freedom.
    let lost = (places.len() as f64 / (places.len() as f64 - 2.0).max(0.5)).sqrt();
    [
        SIGMA_PER_MEDIAN_2D * lost * median(horizontal.collect()),
        SIGMA_PER_MEDIAN * lost * median(vertical.collect()),
    ]
}

/// What each of so many places of GPS is worth, compared to an independent one.
pub(super) fn worth(places: usize) -> f64 {
    (GPS_WORTH / places.max(1) as f64).min(1.0)
}

/// Refines `start` with all observations.
pub(super) fn refine(
    start: &Similarity,
    gps: &[Sighting],
    control: &[Sighting],
    up: &Up,
) -> Result<Refined, GeoError> {
    let places = || gps.iter().chain(control);
    let middle = places().map(|place| place.model).sum::<DVec3>() / places().count().max(1) as f64;
    let worth = worth(gps.len());
    let mut similarity = *start;
    let mut last = None;
    for _ in 0..ROUNDS {
        let mut normal = Normal::default();
        let spreads = [Spread::of(gps, &similarity), Spread::of(control, &similarity)];
        gps.iter().for_each(|place| observe(&mut normal, &similarity, middle, place, &spreads[0], worth));
        control.iter().for_each(|place| observe(&mut normal, &similarity, middle, place, &spreads[1], 1.0));
        observe_up(&mut normal, &similarity, up);
        normal.add(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], 0.0, UNKNOWN_HEIGHT_M.powi(-2));
        let (step, covariance) = normal
            .solve()
            .ok_or(GeoError::NoFit("the places of the photographs or control points do not tell a scale"))?;
        similarity = moved(&similarity, middle, &step);
        last = Some((spreads, covariance));
    }
    let (spreads, covariance) = last.ok_or(GeoError::NoFit("nothing was fitted"))?;
    let sigma = |unknowns: &[usize]| unknowns.iter().map(|&i| covariance[i][i]).sum::<f64>().sqrt();
    let uncertainty = FitUncertainty {
        tilt_deg: sigma(&[0, 1]).to_degrees(),
        heading_deg: sigma(&[2]).to_degrees(),
        scale_share: sigma(&[3]),
        horizontal_m: sigma(&[4, 5]),
        vertical_m: sigma(&[6]),
    };
    Ok(Refined { similarity, spreads, uncertainty })
}

/// Adds the equations of a place.
fn observe(
    normal: &mut Normal,
    similarity: &Similarity,
    middle: DVec3,
    place: &Sighting,
    spread: &Spread,
    worth: f64,
) {
    let arm = similarity.scale * (similarity.rotation * (place.model - middle));
    let off = place.residual(similarity);
    let weight = spread.weight(similarity, place, worth);
    normal.add(&[0.0, arm.z, -arm.y, arm.x, 1.0, 0.0, 0.0], -off.x, weight.x);
    normal.add(&[-arm.z, 0.0, arm.x, arm.y, 0.0, 1.0, 0.0], -off.y, weight.y);
    normal.add(&[arm.y, -arm.x, 0.0, arm.z, 0.0, 0.0, 1.0], -off.z, weight.z);
}

/// Adds the equations of the direction of up.
fn observe_up(normal: &mut Normal, similarity: &Similarity, up: &Up) {
    let is = similarity.rotation * up.direction;
    let weight = up.sigma_rad.powi(-2);
    normal.add(&[0.0, is.z, -is.y, 0.0, 0.0, 0.0, 0.0], -is.x, weight);
    normal.add(&[-is.z, 0.0, is.x, 0.0, 0.0, 0.0, 0.0], -is.y, weight);
}

fn weight(residual_in_sigmas: f64) -> f64 {
    (1.0 + (residual_in_sigmas / QUARTER_AT).powi(2)).powi(-2)
}

/// The similarity after a step that turns and stretches about `middle`.
fn moved(similarity: &Similarity, middle: DVec3, step: &Row) -> Similarity {
    let [x, y, z, log_scale, east, north, up] = *step;
    // A wild step of a poor start must not turn the scale into nothing.
    let scale = similarity.scale * log_scale.clamp(-0.5, 0.5).exp();
    let rotation = (DQuat::from_scaled_axis(DVec3::new(x, y, z)) * similarity.rotation).normalize();
    let at = similarity.apply(middle) + DVec3::new(east, north, up);
    Similarity { scale, rotation, translation: at - scale * (rotation * middle) }
}
