//! Where a reconstruction lies on the earth: the similarity that takes it to the GPS of its photographs and to control
//! points.
//!
//! GPS of drones is a poor level: its heights drift by metres within a flight, and the errors of neighbouring photographs
//! are alike. So the direction of up is an observation of its own ([`Up`]), from how the cameras hung and how the ground
//! lies. Each observation counts by its standard deviation. Those of GPS are estimated from the residuals, so that an
//! accurate receiver decides the tilt itself.
//!
//! It begins with the pair of places that most others agree with ([`start`]), and goes on with least squares in which
//! places that disagree lose their weight ([`refine`]). The same input gives the same result.
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
pub use observation::Sighting;
use refine::refine;
use start::start;
pub use up::Up;

/// Fewest places that a fit by GPS takes: with two, nothing would tell that one is wrong.
const GPS_MIN: usize = 3;

/// Places that make the scale change more than so many times contradict each other: noise of any kind shrinks the scale.
const SCALE_CHANGE_MAX: f64 = 4.0;

/// A reconstruction's place.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// To ENU of the site.
    pub similarity: Similarity,
    /// How well GPS agrees; `None` without GPS.
    pub gps: Option<GpsResiduals>,
    /// For each place of GPS, whether it agrees with most of the others.
    pub agrees: Vec<bool>,
    /// How well the place is known.
    pub uncertainty: FitUncertainty,
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
    let start = start(begin, up.direction)
        .ok_or(GeoError::NoFit("all photographs or control points have the same place"))?;
    let refined = refine(&start, gps, control, up)?;
    let changed = refined.similarity.scale / start.scale;
    if !(1.0 / SCALE_CHANGE_MAX..=SCALE_CHANGE_MAX).contains(&changed) {
        return Err(GeoError::NoFit("the places of photographs or control points contradict the poses"));
    }
    let agrees: Vec<bool> =
        gps.iter().map(|place| refined.spread.holds(&refined.similarity, place)).collect();
    let gps = (!gps.is_empty()).then(|| residuals(gps, &agrees, &refined.similarity));
    Ok(Fit { similarity: refined.similarity, gps, agrees, uncertainty: refined.uncertainty })
}

fn residuals(gps: &[Sighting], agrees: &[bool], similarity: &Similarity) -> GpsResiduals {
    let agreeing = || gps.iter().zip(agrees).filter(|(_, agrees)| **agrees).map(|(place, _)| place);
    let rms = |squares: &mut dyn Iterator<Item = f64>| {
        let (sum, count) = squares.fold((0.0, 0), |(sum, count), square| (sum + square, count + 1));
        (sum / f64::from(count.max(1))).sqrt()
    };
    let off = |place: &Sighting| place.residual(similarity);
    GpsResiduals {
        photographs: gps.len(),
        agreeing: agreeing().count(),
        horizontal_rms_m: rms(&mut agreeing().map(|place| off(place).truncate().length_squared())),
        vertical_rms_m: rms(&mut agreeing()
            .filter(|place| place.has_height)
            .map(|place| off(place).z.powi(2))),
    }
}

#[cfg(test)]
mod tests;
