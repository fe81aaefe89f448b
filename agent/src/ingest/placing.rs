//! Where a reconstruction lies on the earth, from GPS and control points.

use std::collections::HashMap;

use cosurf_geo::{
    ControlPoint, Fit, GeoError, Geodetic, Georeference, Gps, PointResidual, Sighting, Similarity, SiteFrame,
    Up, fit,
};
use cosurf_scene::Pose;
use glam::{DQuat, DVec3};

use super::control::{SeenPoint, seen};
use super::photographs::Photographs;
use super::reconstruction::{Posed, Reconstruction};

/// GPS of the best receivers, RTK, is not better than this, metres.
const GPS_SIGMA_MIN_M: f64 = 0.02;
/// Origins are round, so that flights of one place are likely to share theirs: degrees, about 10 m.
const ORIGIN_STEP_DEG: f64 = 1e-4;

/// What is known about places before the photographs have poses.
pub(super) struct Places {
    gps: HashMap<String, Gps>,
    control: Vec<ControlPoint>,
    site: SiteFrame,
}

/// A reconstruction's place.
pub(super) struct Placed {
    pub(super) similarity: Similarity,
    /// `None` if nothing tells the place and the scale.
    pub(super) georeference: Option<Georeference>,
    /// Names and reasons of GPS and control points that do not count.
    pub(super) left_out: Vec<(String, String)>,
    /// How many places of GPS, or how many control points without GPS, agree.
    pub(super) agreeing: usize,
}

impl Places {
    /// The places of photographs, about `origin`, or else the median of GPS or of the control points. `None` if there are
    /// too few places for a fit.
    pub(super) fn of(photographs: &Photographs, origin: Option<Geodetic>) -> Result<Option<Self>, GeoError> {
        let usable = photographs.usable.iter();
        let gps: HashMap<String, Gps> =
            usable.filter_map(|photograph| Some((photograph.name.clone(), photograph.gps?))).collect();
        let control = photographs.control.clone();
        if gps.len() < 3 && control.len() < 2 {
            return Ok(None);
        }
        let places: Vec<Geodetic> = match gps.len() {
            3.. => gps.values().map(geodetic).collect(),
            _ => control.iter().map(|point| point.place).collect(),
        };
        let site = SiteFrame::new(origin.unwrap_or_else(|| round_median(&places)))?;
        Ok(Some(Self { gps, control, site }))
    }

    /// Fits a reconstruction.
    pub(super) fn place(&self, its: &Reconstruction, up: &Up) -> Result<Placed, GeoError> {
        let with_gps: Vec<(&Posed, &Gps)> =
            its.posed.iter().filter_map(|posed| Some((posed, self.gps.get(&posed.name)?))).collect();
        let gps: Vec<Sighting> = with_gps.iter().map(|(posed, gps)| self.sighting(posed, gps)).collect();
        let points = seen(&self.control, its, &self.site);
        let control: Vec<Sighting> = points.control.iter().map(|point| point.sighting).collect();
        let Fit { similarity, gps: residuals, agrees, uncertainty } = fit(&gps, &control, up)?;
        let residual = |point: &SeenPoint| PointResidual {
            name: point.name.clone(),
            photographs: point.photographs,
            residual_m: (similarity.apply(point.sighting.model) - point.sighting.enu_m).to_array(),
        };
        let georeference = Georeference {
            gps: residuals,
            uncertainty: Some(uncertainty),
            control: points.control.iter().map(residual).collect(),
            check: points.check.iter().map(residual).collect(),
            ..Georeference::at(self.site.origin())?
        };
        let mut left_out = points.left_out;
        for ((posed, _), (place, _)) in
            with_gps.iter().zip(gps.iter().zip(&agrees)).filter(|(_, (_, agrees))| !**agrees)
        {
            let off_m = (similarity.apply(place.model) - place.enu_m).length();
            let reason = format!(
                "is {off_m:.0} m from where the photographs show it was taken; only its pixels count"
            );
            left_out.push((format!("GPS of {}", posed.name), reason));
        }
        let agreeing =
            if gps.is_empty() { control.len() } else { agrees.iter().filter(|agrees| **agrees).count() };
        Ok(Placed { similarity, georeference: Some(georeference), left_out, agreeing })
    }

    fn sighting(&self, posed: &Posed, gps: &Gps) -> Sighting {
        let enu_m = self.site.enu_from_geodetic(&geodetic(gps));
        Sighting {
            model: posed.cam_from_world.center(),
            enu_m,
            has_height: gps.height_m.is_some(),
            sigma_m: GPS_SIGMA_MIN_M,
        }
    }
}

/// Which direction of a reconstruction is up.
pub(super) fn up_of<'a>(poses: impl Iterator<Item = &'a Pose> + Clone, points: &[DVec3]) -> Option<Up> {
    let forward: Vec<DVec3> = poses.clone().map(Pose::forward).collect();
    let right: Vec<DVec3> = poses.map(|pose| pose.rotation.inverse() * DVec3::X).collect();
    Up::of(&forward, &right, points)
}

/// Only turns up to z: scale and place are unknown.
pub(super) fn upright(up: &Up) -> Placed {
    let rotation = DQuat::from_rotation_arc(up.direction, DVec3::Z);
    let similarity = Similarity { scale: 1.0, rotation, translation: DVec3::ZERO };
    Placed { similarity, georeference: None, left_out: Vec::new(), agreeing: 0 }
}

fn geodetic(gps: &Gps) -> Geodetic {
    let Gps { latitude_deg, longitude_deg, height_m } = *gps;
    Geodetic { latitude_deg, longitude_deg, height_m: height_m.unwrap_or(0.0) }
}

/// The median of places, rounded to [`ORIGIN_STEP_DEG`] and whole metres.
fn round_median(places: &[Geodetic]) -> Geodetic {
    let median = |value: fn(&Geodetic) -> f64| {
        let mut values: Vec<f64> = places.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    // Division by a whole number gives the decimal fraction that people read.
    let degrees = |value: f64| (value / ORIGIN_STEP_DEG).round() / (1.0 / ORIGIN_STEP_DEG).round();
    Geodetic {
        latitude_deg: degrees(median(|place| place.latitude_deg)),
        longitude_deg: degrees(median(|place| place.longitude_deg)),
        height_m: median(|place| place.height_m).round(),
    }
}
