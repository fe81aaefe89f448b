//! Where a reconstruction lies on the earth, from GPS and control points.

use std::collections::HashMap;

use cosurf_geo::{
    ControlPoint, GeoError, Geodetic, Georeference, Gps, PointResidual, Residuals, Sighting, Similarity,
    SiteFrame, Up, fit,
};
use cosurf_scene::Pose;
use glam::{DQuat, DVec3};

use super::adjustment::{KnownCenter, KnownPoint};
use super::control::{SeenPoint, seen};
use super::gps::geodetic;
use super::photographs::Photographs;
use super::plausible::{Contradiction, check_axes, check_place, gps_elsewhere};
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
    /// How far the poses contradict the places that decide: three control points outweigh GPS.
    pub(super) contradiction: Contradiction,
    /// How far they contradict any places.
    pub(super) doubt: Contradiction,
    /// What an adjustment can go by, in ENU of the site.
    pub(super) centers: Vec<KnownCenter>,
    pub(super) points: Vec<KnownPoint>,
}

impl Places {
    /// The places of photographs, about `origin`, or else the median of GPS or of the control points. `None` if there are
    /// too few places for a fit.
    pub(super) fn of(photographs: &Photographs, origin: Option<Geodetic>) -> Result<Option<Self>, GeoError> {
        let usable = photographs.usable.iter();
        let gps: HashMap<String, Gps> =
            usable.filter_map(|photograph| Some((photograph.name.clone(), photograph.gps?))).collect();
        let control = photographs.control.clone();
        check_place(&photographs.usable, &control)?;
        if gps.len() < 3 && control.iter().filter(|point| !point.is_check()).count() < 2 {
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
        let (photographs, gps): (Vec<usize>, Vec<Sighting>) = self.sightings(its).unzip();
        let seen = seen(&self.control, its, &self.site);
        let control: Vec<Sighting> = seen.control.iter().map(|point| point.sighting).collect();
        check_axes(&control, up)?;
        let fit = fit(&gps, &control, up)?;
        let similarity = fit.similarity;
        let gps_rms_m = fit.residuals.as_ref().map_or(0.0, |its| its.horizontal_rms_m);
        let residual = |point: &SeenPoint| residual(point, &similarity);
        let agreeing = seen.control.iter().zip(&fit.control).filter(|(_, its)| its.agrees);
        let residuals = Residuals {
            gps: fit.residuals,
            uncertainty: Some(fit.uncertainty),
            control: agreeing.map(|(point, _)| residual(point)).collect(),
            check: seen.check.iter().map(residual).collect(),
        };
        let georeference = Georeference { residuals, ..Georeference::at(self.site.origin())? };
        let mut left_out = seen.left_out;
        left_out.extend(gps_elsewhere(control.len(), gps_rms_m));
        let wrong = seen.control.iter().zip(&fit.control).filter(|(_, its)| !its.agrees);
        left_out.extend(wrong.map(|(point, _)| wrong_control(&residual(point))));
        let wrong = photographs.iter().zip(&gps).zip(&fit.gps).filter(|(_, its)| !its.agrees);
        left_out
            .extend(wrong.map(|((i, place), _)| wrong_gps(&its.posed[*i].name, off_m(place, &similarity))));
        let by_gps = Contradiction::of("places of GPS", &gps, &similarity);
        let by_control = Contradiction::of("control points", &control, &similarity);
        let contradiction = if control.len() >= 3 { by_control } else { by_control.or(by_gps) };
        let judged = if gps.is_empty() { &fit.control } else { &fit.gps };
        let agreeing = judged.iter().filter(|its| its.agrees).count();
        let centers = photographs.into_iter().zip(&gps).zip(&fit.gps);
        let centers = centers
            .map(|((photograph, gps), its)| KnownCenter { photograph, at_m: gps.enu_m, weight: its.weight })
            .collect();
        let points = seen.control.into_iter().zip(&fit.control);
        let points = points.map(|(point, its)| known_point(point, its.weight, &similarity)).collect();
        Ok(Placed {
            similarity,
            georeference: Some(georeference),
            left_out,
            agreeing,
            contradiction,
            doubt: by_control.or(by_gps),
            centers,
            points,
        })
    }

    /// GPS of the photographs with poses, with their indices.
    fn sightings(&self, its: &Reconstruction) -> impl Iterator<Item = (usize, Sighting)> {
        let with_gps = its.posed.iter().enumerate();
        with_gps.filter_map(|(i, posed)| Some((i, self.sighting(posed, self.gps.get(&posed.name)?))))
    }

    fn sighting(&self, posed: &Posed, gps: &Gps) -> Sighting {
        let enu_m = self.site.enu_from_geodetic(&geodetic(gps));
        let told_m = gps.accuracy.map_or([0.0; 2], |its| [its.horizontal_m, its.vertical_m]);
        Sighting {
            model: posed.cam_from_world.center(),
            enu_m,
            has_height: gps.height_m.is_some(),
            sigma_m: told_m.map(|sigma_m| sigma_m.max(GPS_SIGMA_MIN_M)),
            is_told: gps.accuracy.is_some(),
        }
    }
}

/// How far a place is from where it should be.
fn off_m(place: &Sighting, similarity: &Similarity) -> DVec3 {
    similarity.apply(place.model) - place.enu_m
}

fn residual(point: &SeenPoint, similarity: &Similarity) -> PointResidual {
    PointResidual {
        name: point.name.clone(),
        photographs: point.marks.len(),
        residual_m: off_m(&point.sighting, similarity).to_array(),
    }
}

fn known_point(point: SeenPoint, weight: DVec3, similarity: &Similarity) -> KnownPoint {
    let Sighting { model, enu_m, .. } = point.sighting;
    KnownPoint { seen_m: similarity.apply(model), at_m: enu_m, weight, marks: point.marks }
}

/// Name and reason of a control point that does not count.
fn wrong_control(its: &PointResidual) -> (String, String) {
    let off_m = DVec3::from(its.residual_m).length();
    let reason = format!(
        "is {off_m:.1} m from where the photographs and the other points say; it does not count, so check its place and its marks"
    );
    (format!("control point {}", its.name), reason)
}

/// Name and reason of GPS that does not count.
fn wrong_gps(photograph: &str, off_m: DVec3) -> (String, String) {
    let reason = format!(
        "is {:.0} m from where the photographs show it was taken; only its pixels count",
        off_m.length()
    );
    (format!("GPS of {photograph}"), reason)
}

/// Which direction of a reconstruction is up. `None` without photographs.
pub(super) fn up_of(its: &Reconstruction) -> Option<Up> {
    let poses = || its.posed.iter().map(|posed| &posed.cam_from_world);
    let forward: Vec<DVec3> = poses().map(Pose::forward).collect();
    let right: Vec<DVec3> = poses().map(|pose| pose.rotation.inverse() * DVec3::X).collect();
    let points: Vec<DVec3> = its.points.iter().map(|point| point.position).collect();
    Up::of(&forward, &right, &points)
}

/// Only turns up to z: scale and place are unknown.
pub(super) fn upright(up: &Up) -> Placed {
    let rotation = DQuat::from_rotation_arc(up.direction, DVec3::Z);
    let similarity = Similarity { scale: 1.0, rotation, translation: DVec3::ZERO };
    Placed {
        similarity,
        georeference: None,
        left_out: Vec::new(),
        agreeing: 0,
        contradiction: Contradiction::NONE,
        doubt: Contradiction::NONE,
        centers: Vec::new(),
        points: Vec::new(),
    }
}

/// The median of places, rounded to [`ORIGIN_STEP_DEG`] and whole metres.
pub(super) fn round_median(places: &[Geodetic]) -> Geodetic {
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
