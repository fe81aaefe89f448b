//! Whether a list of control points is about the place that the photographs show. A wrong zone, or columns in another order,
//! would bend the model or carry it away, and every residual would look small. And whether poses are of the flight that GPS
//! and control points tell of.

use std::fmt;

use cosurf_geo::{ControlPoint, GeoError, Sighting, Similarity, SiteFrame, Up, median};
use glam::{DMat2, DVec2, DVec3};

use super::gps::{ELSEWHERE_M, a_few, geodetic};
use super::names::{Meant, Names};
use super::photographs::Photograph;

/// GPS farther than this from where control points put the photographs is not explained by its errors, metres.
const GPS_OFF_M: f64 = 50.0;
/// How surely the direction of up must be known to tell a mirrored list, radians.
const UP_SIGMA_MAX_RAD: f64 = 0.3;
/// The normalised determinant is 1 for points that lie as the photographs show them, and -1 for mirrored ones.
const MIRRORED_BELOW: f64 = -0.5;

/// How far poses put places from where they were measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Contradiction {
    /// What was measured.
    places: &'static str,
    /// Median distance between where the poses put the places and where they are, metres.
    off_m: f64,
    /// Median distance of the places from their middle, metres.
    apart_m: f64,
    /// The former as a share of the latter.
    pub(super) share: f64,
}

impl Contradiction {
    /// Of nothing that was measured.
    pub(super) const NONE: Self = Self { places: "nothing", off_m: 0.0, apart_m: 0.0, share: 0.0 };

    /// Of places that a similarity puts on the earth. Heights do not count: those of GPS are coarse.
    pub(super) fn of(places: &'static str, sightings: &[Sighting], similarity: &Similarity) -> Self {
        if sightings.is_empty() {
            return Self::NONE;
        }
        let middle = sightings.iter().map(|its| its.enu_m).sum::<DVec3>() / sightings.len() as f64;
        let flat = |vector: DVec3| vector.truncate().length();
        let off_m =
            median(sightings.iter().map(|its| flat(similarity.apply(its.model) - its.enu_m)).collect());
        let apart_m = median(sightings.iter().map(|its| flat(its.enu_m - middle)).collect());
        Self { places, off_m, apart_m, share: off_m / apart_m.max(f64::MIN_POSITIVE) }
    }

    /// The larger one.
    pub(super) fn or(self, other: Self) -> Self {
        if other.share > self.share { other } else { self }
    }
}

impl fmt::Display for Contradiction {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { places, off_m, apart_m, .. } = self;
        write!(
            f,
            "{places} lie {off_m:.1} m from where the poses put them, and only {apart_m:.1} m from their own middle (medians)"
        )
    }
}

fn refused(reason: String) -> GeoError {
    GeoError::Refused { path: "gcp_list.txt".into(), reason }
}

/// An error if the points lie far from the GPS of the photographs that show them.
pub(super) fn check_place(photographs: &[Photograph], points: &[ControlPoint]) -> Result<(), GeoError> {
    let names = names_of(photographs);
    let mut off_m = Vec::new();
    for point in points {
        let site = SiteFrame::new(point.place)?;
        let seen_from =
            point.marks.iter().filter_map(|mark| photographs[names.find(&mark.photograph).one()?].gps);
        off_m.extend(seen_from.map(|gps| site.enu_from_geodetic(&geodetic(&gps)).length()));
    }
    off_m.sort_by(f64::total_cmp);
    match off_m.get(off_m.len() / 2) {
        Some(off_m) if *off_m > ELSEWHERE_M => Err(refused(format!(
            "the points lie {:.0} km from the GPS of the photographs that show them; check the coordinate system in the first \
             line, and that each line begins with east, north and height",
            off_m / 1000.0
        ))),
        _ => Ok(()),
    }
}

/// An error if the points lie mirrored to where the photographs show them: their first two columns are in the wrong order.
pub(super) fn check_axes(control: &[Sighting], up: &Up) -> Result<(), GeoError> {
    if control.len() < 3 || up.sigma_rad > UP_SIGMA_MAX_RAD {
        return Ok(());
    }
    let east = up.direction.any_orthonormal_vector();
    let north = up.direction.cross(east);
    let seen: Vec<DVec2> =
        control.iter().map(|its| DVec2::new(its.model.dot(east), its.model.dot(north))).collect();
    let told: Vec<DVec2> = control.iter().map(|its| its.enu_m.truncate()).collect();
    let scale = (spread(&seen, &seen).determinant() * spread(&told, &told).determinant()).sqrt();
    if scale > 0.0 && spread(&told, &seen).determinant() < MIRRORED_BELOW * scale {
        return Err(refused(
            "the points lie mirrored to where the photographs show them; write each line as `east north height`, in this \
             order"
                .to_owned(),
        ));
    }
    Ok(())
}

/// The sum of the products of two lists' distances from their means.
fn spread(a: &[DVec2], b: &[DVec2]) -> DMat2 {
    let mean = |of: &[DVec2]| of.iter().sum::<DVec2>() / of.len().max(1) as f64;
    let (mean_a, mean_b) = (mean(a), mean(b));
    let outer = |a: DVec2, b: DVec2| DMat2::from_cols(a * b.x, a * b.y);
    a.iter().zip(b).map(|(a, b)| outer(*a - mean_a, *b - mean_b)).fold(DMat2::ZERO, |sum, each| sum + each)
}

/// What is told if GPS lies elsewhere than control points put the photographs.
pub(super) fn gps_elsewhere(control: usize, horizontal_rms_m: f64) -> Option<(String, String)> {
    let reason = || {
        format!(
            "lies {horizontal_rms_m:.0} m from where the control points put the photographs; check the coordinate system of \
             gcp_list.txt"
        )
    };
    (control >= 3 && horizontal_rms_m > GPS_OFF_M).then(|| ("GPS".to_owned(), reason()))
}

/// What is told of marks in photographs that are not in the folder.
pub(super) fn missing_photographs(
    photographs: &[Photograph],
    points: &[ControlPoint],
) -> Option<(String, String)> {
    let here = names_of(photographs);
    let marks = points.iter().flat_map(|point| &point.marks);
    let missing: Vec<&str> = marks
        .map(|mark| mark.photograph.as_str())
        .filter(|photograph| here.find(photograph) == Meant::None)
        .collect();
    let names = || a_few(missing.iter().copied());
    let reason = || format!("{} in photographs that are not here ({})", count(missing.len()), names());
    (!missing.is_empty()).then(|| ("gcp_list.txt".to_owned(), reason()))
}

fn names_of(photographs: &[Photograph]) -> Names {
    Names::of(photographs.iter().map(|photograph| photograph.name.as_str()))
}

fn count(marks: usize) -> String {
    if marks == 1 { "1 mark is".into() } else { format!("{marks} marks are") }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_geo::{Geodetic, Gps, Mark};
    use glam::{DQuat, DVec3};

    use super::*;

    fn photograph(name: &str, longitude_deg: f64) -> Photograph {
        let gps = Some(Gps { latitude_deg: 53.0, longitude_deg, height_m: Some(170.0), accuracy: None });
        Photograph {
            name: name.into(),
            size_px: [640, 480],
            camera: "camera".into(),
            gps,
            has_exif_gps: true,
            is_listed: false,
            state: [0; 2],
            mask: None,
        }
    }

    fn points(longitude_deg: f64, photographs: &[&str]) -> Vec<ControlPoint> {
        let place = Geodetic { latitude_deg: 53.001, longitude_deg, height_m: 70.0 };
        let mark = |name: &&str| Mark { photograph: (*name).to_owned(), at_px: DVec2::ONE };
        vec![ControlPoint { name: "a".into(), place, marks: photographs.iter().map(mark).collect() }]
    }

    #[test]
    fn points_in_another_zone_are_refused_and_near_ones_are_not() {
        let photographs = [photograph("100MEDIA/A.JPG", 16.0), photograph("b.jpg", 16.001)];
        check_place(&photographs, &points(16.01, &["a.jpg", "b.jpg"])).unwrap();
        check_place(&photographs, &points(22.0, &["elsewhere.jpg"])).unwrap();
        let error = check_place(&photographs, &points(22.0, &["a.jpg", "b.jpg"])).unwrap_err().to_string();
        assert!(error.contains("gcp_list.txt: the points lie 403 km from the GPS"), "{error}");
    }

    /// Five points, turned in any way, with the coordinates that a list tells of them.
    fn sightings(told: impl Fn(DVec3) -> DVec3) -> (Vec<Sighting>, Up) {
        let turn = DQuat::from_scaled_axis(DVec3::new(0.4, -1.0, 2.0));
        let at =
            [[0.0, 0.0, 1.0], [40.0, 5.0, 0.0], [-10.0, 30.0, 3.0], [25.0, 60.0, 0.0], [50.0, 45.0, 2.0]];
        let sighting = |at: [f64; 3]| {
            let at = DVec3::from(at);
            Sighting {
                model: 0.1 * (turn * at),
                enu_m: told(at),
                has_height: true,
                sigma_m: [0.05; 2],
                is_told: false,
            }
        };
        (at.map(sighting).to_vec(), Up { direction: turn * DVec3::Z, sigma_rad: 0.1 })
    }

    #[test]
    fn swapped_columns_are_noticed_and_a_wrong_point_is_not_taken_for_them() {
        let (right, up) = sightings(|at| at);
        check_axes(&right, &up).unwrap();
        let (mut blunder, up) = sightings(|at| at);
        blunder[2].enu_m += DVec3::new(50.0, -50.0, 0.0);
        check_axes(&blunder, &up).unwrap();
        let (swapped, up) = sightings(|at| DVec3::new(at.y, at.x, at.z));
        assert!(check_axes(&swapped, &up).unwrap_err().to_string().contains("mirrored"));
        check_axes(&swapped[..2], &up).unwrap();
        check_axes(&swapped, &Up { sigma_rad: 1.0, ..up }).unwrap();
    }

    #[test]
    fn marks_in_missing_photographs_are_told_in_one_line() {
        let photographs = [photograph("a.jpg", 16.0)];
        let told = missing_photographs(&photographs, &points(16.0, &["A.JPG", "x1", "x2", "x3", "x4", "x1"]));
        assert_eq!(told.unwrap().1, "5 marks are in photographs that are not here (x1, x2, x3, …)");
        assert_eq!(missing_photographs(&photographs, &points(16.0, &["a.jpg"])), None);
    }

    #[test]
    fn places_contradict_poses_that_are_not_of_them() {
        let (mut places, _) = sightings(|at| at);
        let turn = DQuat::from_scaled_axis(DVec3::new(0.4, -1.0, 2.0)).inverse();
        let right = Similarity { scale: 10.0, rotation: turn, translation: DVec3::ZERO };
        let of = |places: &[Sighting], similarity| Contradiction::of("places of GPS", places, &similarity);
        assert!(of(&places, right).share < 1e-9);
        // One that is far off is a blunder of GPS, not of the poses.
        places[1].enu_m.x += 5000.0;
        assert!(of(&places[..], right).share < 1e-9);
        let collapsed = Similarity { scale: 0.1, ..right };
        let off = of(&sightings(|at| at).0, collapsed);
        assert!(off.share > 1.0 && off.or(Contradiction::NONE) == off && Contradiction::NONE.or(off) == off);
        assert_eq!(
            off.to_string(),
            "places of GPS lie 39.9 m from where the poses put them, and only 32.2 m from their own middle (medians)"
        );
    }

    #[test]
    fn gps_that_is_only_bad_is_not_told() {
        assert_eq!(gps_elsewhere(3, 12.0), None);
        assert_eq!(gps_elsewhere(0, 400.0), None);
        assert!(gps_elsewhere(3, 400.0).is_some());
    }
}
