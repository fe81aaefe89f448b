//! Where a reconstruction lies on the earth: the similarity that takes it to the GPS of its photographs and to control
//! points.
//!
//! GPS of drones is a poor level: its heights drift by metres within a flight, and the errors of neighbouring photographs
//! are alike. So the direction of up is an observation of its own ([`Up`]), from how the cameras hung and how the ground
//! lies. Each observation counts by its standard deviation. Those of GPS are estimated from the residuals, so that an
//! accurate receiver decides the tilt itself. Of receivers that tell their accuracy, as RTK does, only the factor is
//! estimated by which all of them are worse than they tell: one with a fixed solution outweighs one without.
//!
//! It begins with the pair of places that most others agree with ([`start`]), and goes on with least squares in which
//! places that disagree lose their weight ([`refine`]). Where enough receivers tell their accuracy, it begins with the best
//! of these, if they turn out to be about as accurate as they tell. The same input gives the same result.
//!
//! What it knows nothing about: cameras and pixels. Where to start reading: [`fit()`].

mod normal;
mod observation;
mod refine;
mod start;
mod up;

use crate::error::GeoError;
use crate::georeference::{FitUncertainty, GpsResiduals};
use crate::similarity::Similarity;
use glam::DVec3;
pub use observation::{Sighting, median};
use refine::{JUDGED_MIN, Refined, Spread, refine, worth};
use start::start;
pub use up::Up;

/// Fewest places that a fit by GPS takes: with two, nothing would tell that one is wrong.
const GPS_MIN: usize = 3;

/// Fewest control points of which one can be wrong: the others must outvote it.
const CONTROL_JUDGED_MIN: usize = 4;

/// Places that tell at most so many times the standard deviation of the best ones count as these.
const ALIKE_TIMES: f64 = 4.0;

/// Receivers whose places are worse than so many times what they tell are not believed. RTK tells 1 cm; camera and antenna
/// are apart, and poses bend, by decimetres.
const BELIEVED_TIMES: f64 = 30.0;

/// Places that make the scale change more than so many times contradict each other: noise of any kind shrinks the scale.
const SCALE_CHANGE_MAX: f64 = 4.0;

/// A reconstruction's place.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// To ENU of the site.
    pub similarity: Similarity,
    /// How well GPS agrees; `None` without GPS.
    pub residuals: Option<GpsResiduals>,
    /// What each place of GPS is worth.
    pub gps: Vec<Judged>,
    /// What each control point is worth.
    pub control: Vec<Judged>,
    /// How well the place is known.
    pub uncertainty: FitUncertainty,
}

/// What a place is worth in a fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// Whether it agrees with most of the others. Fewer than four control points always agree: nobody could tell which one
    /// is wrong.
    pub agrees: bool,
    /// Inverse variances along east, north and up, 1/m²; next to nothing for a place that contradicts the others. All places
    /// of GPS together are worth only a few, because their errors are alike.
    pub weight: DVec3,
}

/// Fits the places that GPS gives to photographs (`gps`), and control points (`control`). A fit takes two control points,
/// or three photographs with GPS.
pub fn fit(gps: &[Sighting], control: &[Sighting], up: &Up) -> Result<Fit, GeoError> {
    // Three control points outvote any GPS, two are only better than none.
    let begin = match (gps.len(), control.len()) {
        (_, 3..) => control,
        (GPS_MIN.., _) => gps,
        (_, 2) => control,
        _ => {
            return Err(GeoError::NoFit(
                "fewer than 3 photographs with a pose have GPS, and fewer than 2 control points are seen",
            ));
        }
    };
    let best = if control.len() < 3 { most_accurate(gps) } else { Vec::new() };
    // A crowd with an error in common must not outvote a few that RTK has fixed.
    let by_best = (best.len() >= JUDGED_MIN).then(|| fit_from(&best, gps, control, up).ok()).flatten();
    let refined = match by_best.filter(|refined| refined.spreads[0].believes(BELIEVED_TIMES)) {
        Some(refined) => refined,
        None => fit_from(begin, gps, control, up)?,
    };
    let (similarity, uncertainty) = (refined.similarity, refined.uncertainty);
    let judge = |spread: &Spread, worth: f64, place: &Sighting| Judged {
        agrees: spread.holds(&similarity, place),
        weight: spread.weight(&similarity, place, worth),
    };
    let [of_gps, of_control] = &refined.spreads;
    let worth = worth(gps.len());
    let gps_judged: Vec<Judged> = gps.iter().map(|place| judge(of_gps, worth, place)).collect();
    let may_judge = control.len() >= CONTROL_JUDGED_MIN;
    let control = control.iter().map(|place| judge(of_control, 1.0, place));
    let control = control.map(|its| Judged { agrees: its.agrees || !may_judge, ..its }).collect();
    let residuals = (!gps.is_empty()).then(|| residuals(gps, &gps_judged, &similarity));
    Ok(Fit { similarity, residuals, gps: gps_judged, control, uncertainty })
}

/// The fit that begins with some places, and goes on with all.
fn fit_from(
    begin: &[Sighting],
    gps: &[Sighting],
    control: &[Sighting],
    up: &Up,
) -> Result<Refined, GeoError> {
    let start = start(begin, up.direction)
        .ok_or(GeoError::NoFit("all photographs or control points have the same place"))?;
    let refined = refine(&start, gps, control, up)?;
    let changed = refined.similarity.scale / start.scale;
    match (1.0 / SCALE_CHANGE_MAX..=SCALE_CHANGE_MAX).contains(&changed) {
        true => Ok(refined),
        false => Err(GeoError::NoFit("the places of photographs or control points contradict the poses")),
    }
}

/// The places that tell to be about as accurate as the best of them.
fn most_accurate(gps: &[Sighting]) -> Vec<Sighting> {
    let horizontal_m = |place: &Sighting| place.sigma_m[0];
    let mut told: Vec<Sighting> = gps.iter().filter(|place| place.is_told).copied().collect();
    told.sort_by(|a, b| horizontal_m(a).total_cmp(&horizontal_m(b)));
    let limit_m = told.get(JUDGED_MIN - 1).map_or(0.0, |place| ALIKE_TIMES * horizontal_m(place));
    told.retain(|place| horizontal_m(place) <= limit_m);
    told
}

fn residuals(gps: &[Sighting], judged: &[Judged], similarity: &Similarity) -> GpsResiduals {
    let agreeing = || gps.iter().zip(judged).filter(|(_, its)| its.agrees).map(|(place, _)| place);
    let rms = |squares: &mut dyn Iterator<Item = f64>| {
        let (sum, count) = squares.fold((0.0, 0), |(sum, count), square| (sum + square, count + 1));
        (sum / f64::from(count.max(1))).sqrt()
    };
    let off = |place: &Sighting| place.residual(similarity);
    GpsResiduals {
        photographs: gps.len(),
        with_accuracy: gps.iter().filter(|place| place.is_told).count(),
        agreeing: agreeing().count(),
        horizontal_rms_m: rms(&mut agreeing().map(|place| off(place).truncate().length_squared())),
        vertical_rms_m: rms(&mut agreeing()
            .filter(|place| place.has_height)
            .map(|place| off(place).z.powi(2))),
    }
}

#[cfg(test)]
mod tests;
