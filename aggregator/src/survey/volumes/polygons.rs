//! Polygons of a GeoJSON file (RFC 7946: longitude and latitude, WGS 84).
//!
//! What it knows nothing about: heights.

use std::cmp::Ordering;
use std::fs;
use std::path::Path;

use cosurf_geo::GeoError;
use cosurf_scene::bytes::format_bytes;
use cosurf_scene::{Camera, SceneError};
use geojson::{Feature, GeoJson, GeometryValue, Position};
use glam::DVec2;

use crate::survey::error::SurveyError;
use crate::survey::place::Place;

/// Largest file, bytes.
const FILE_BYTES_MAX: u64 = 64 << 20;
/// Most positions of a ring.
const POSITIONS_MAX: usize = 10_000;
/// A polygon farther than this from all cameras is somewhere else, metres.
const ELSEWHERE_M: f64 = 5_000.0;

/// A polygon on the map.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::survey) struct Polygon {
    /// The property `name`, or `polygon` and its number.
    pub(super) name: String,
    /// First the outer ring, then holes: easting and northing of the corners, metres. The last corner is the first.
    pub(super) rings: Vec<Vec<DVec2>>,
}

/// Reads the polygons of a file. An error if it has none, or other geometries.
pub(in crate::survey) fn read_polygons(path: &Path, place: &Place) -> Result<Vec<Polygon>, SurveyError> {
    let io = |cause| SceneError::io(path, cause);
    let malformed = |reason: String| SurveyError::from(SceneError::malformed(path, reason));
    let bytes = fs::metadata(path).map_err(io)?.len();
    if bytes > FILE_BYTES_MAX {
        let (size, most) = (format_bytes(bytes), format_bytes(FILE_BYTES_MAX));
        return Err(malformed(format!("has {size}, but {most} are the most; give fewer polygons")));
    }
    let text = fs::read_to_string(path).map_err(io)?;
    let json: GeoJson = text.parse().map_err(|error| malformed(format!("not valid GeoJSON: {error}")))?;
    let features = match json {
        GeoJson::FeatureCollection(collection) => collection.features,
        GeoJson::Feature(feature) => vec![feature],
        GeoJson::Geometry(geometry) => vec![Feature::from(geometry)],
    };
    let mut polygons = Vec::new();
    for (i, feature) in features.iter().enumerate() {
        polygons.extend(of_feature(feature, i + 1, place).map_err(malformed)?);
    }
    match polygons.is_empty() {
        true => Err(malformed("has no polygons; draw one around each heap".into())),
        false => Ok(polygons),
    }
}

/// Refuses polygons that lie far from all cameras, before anything is computed.
pub(in crate::survey) fn check_near(
    polygons: &[Polygon],
    path: &Path,
    cameras: &[Camera],
    place: &Place,
) -> Result<(), SurveyError> {
    let eyes = cameras.iter().map(|camera| place.map_from_enu(camera.cam_from_world.center()));
    let eyes: Vec<DVec2> = eyes.map(|at| Ok(at?.truncate())).collect::<Result<_, SurveyError>>()?;
    for Polygon { name, rings } in polygons {
        let corners = rings[0].iter().flat_map(|corner| eyes.iter().map(|eye| eye.distance(*corner)));
        let nearest_m = corners.fold(f64::INFINITY, f64::min);
        if !eyes.is_empty() && nearest_m > ELSEWHERE_M {
            let reason = format!(
                "{name} lies {:.0} km from all photographs; a position in GeoJSON is longitude, then latitude",
                nearest_m / 1000.0
            );
            return Err(SceneError::malformed(path, reason).into());
        }
    }
    Ok(())
}

/// The polygons of a feature; the reason if there is something wrong.
fn of_feature(feature: &Feature, number: usize, place: &Place) -> Result<Vec<Polygon>, String> {
    let name = match feature.property("name").and_then(|name| name.as_str()) {
        Some(name) => name.to_string(),
        None => format!("polygon {number}"),
    };
    let polygon = |rings: &Vec<Vec<Position>>, name: String| {
        let rings =
            rings.iter().map(|ring| of_ring(ring, place).map_err(|reason| format!("{name}: {reason}")));
        let rings = rings.collect::<Result<Vec<_>, _>>()?;
        if rings.is_empty() { Err(format!("{name}: has no ring")) } else { Ok(Polygon { name, rings }) }
    };
    match feature.geometry.as_ref().map(|geometry| &geometry.value) {
        Some(GeometryValue::Polygon { coordinates }) => Ok(vec![polygon(coordinates, name)?]),
        Some(GeometryValue::MultiPolygon { coordinates }) => {
            let part = |(i, rings)| polygon(rings, format!("{name}, part {}", i + 1));
            coordinates.iter().enumerate().map(part).collect()
        }
        _ => Err(format!("{name} is not a polygon; give polygons only")),
    }
}

fn of_ring(ring: &[Position], place: &Place) -> Result<Vec<DVec2>, String> {
    let corner = |position: &Position| {
        match position.as_slice() {
        [longitude, latitude, ..] => place.map_from_degrees(*longitude, *latitude).map_err(|error| match error {
            GeoError::NoPlace { .. } => format!(
                "[{longitude}, {latitude}] is no place on the earth; a position in GeoJSON is longitude, then latitude, in degrees"
            ),
            error => error.to_string(),
        }),
        _ => Err("a position needs longitude and latitude".to_string()),
    }
    };
    let corners: Vec<DVec2> = ring.iter().map(corner).collect::<Result<_, _>>()?;
    if corners.len() < 4 || corners.first() != corners.last() {
        return Err("a ring needs four positions, of which the last is the first again".into());
    }
    if corners.len() > POSITIONS_MAX {
        return Err(format!("a ring has more than {POSITIONS_MAX} positions; simplify it"));
    }
    match crossing(&corners) {
        Some([a, b]) => Err(format!(
            "a ring crosses itself, after its positions {} and {}; draw it around the ground once",
            a + 1,
            b + 1
        )),
        None => Ok(corners),
    }
}

/// Indices of two sides of a ring that cross each other.
fn crossing(ring: &[DVec2]) -> Option<[usize; 2]> {
    let left = |a: DVec2, b: DVec2, of: DVec2| (b - a).perp_dot(of - a).total_cmp(&0.0);
    let are_apart = |a: DVec2, b: DVec2, [c, d]: [DVec2; 2]| {
        let sides = [left(a, b, c), left(a, b, d)];
        !matches!(sides, [Ordering::Less, Ordering::Greater] | [Ordering::Greater, Ordering::Less])
    };
    let cross = |i: usize, j: usize| {
        let [a, b, c, d] = [ring[i], ring[i + 1], ring[j], ring[j + 1]];
        !are_apart(a, b, [c, d]) && !are_apart(c, d, [a, b])
    };
    let sides = ring.len() - 1;
    (0..sides).find_map(|i| (i + 1..sides).find(|j| cross(i, *j)).map(|j| [i, j]))
}

/// Area inside the outer ring and outside of the holes, in the units of the rings.
pub(super) fn area(rings: &[Vec<DVec2>]) -> f64 {
    let of = |ring: &Vec<DVec2>| {
        // Relative to a corner: products of eastings and northings would lose digits.
        let products = ring.windows(2).map(|pair| (pair[0] - ring[0]).perp_dot(pair[1] - ring[0]));
        0.5 * products.sum::<f64>().abs()
    };
    of(&rings[0]) - rings[1..].iter().map(of).sum::<f64>()
}

/// Mean of a ring's corners.
pub(super) fn middle(ring: &[DVec2]) -> DVec2 {
    let corners = &ring[1..];
    corners.iter().sum::<DVec2>() / corners.len() as f64
}

/// Positions along a ring, px, at most a pixel apart. Long sides far outside of a map of this size get fewer.
pub(super) fn along(ring: &[DVec2], size_px: [u32; 2]) -> impl Iterator<Item = DVec2> {
    let most = 4.0 * f64::from(size_px[0].max(size_px[1]));
    ring.windows(2).flat_map(move |pair| {
        let steps = pair[0].distance(pair[1]).min(most).ceil().max(1.0) as u32;
        (0..steps).map(move |step| pair[0].lerp(pair[1], f64::from(step) / f64::from(steps)))
    })
}

/// Where rings cross the row at `y`, ascending.
pub(super) fn crossings(rings: &[Vec<DVec2>], y: f64) -> Vec<f64> {
    let mut crossings: Vec<f64> = rings
        .iter()
        .flat_map(|ring| ring.windows(2))
        .filter(|pair| (pair[0].y < y) != (pair[1].y < y))
        .map(|pair| pair[0].x + (pair[1].x - pair[0].x) * (y - pair[0].y) / (pair[1].y - pair[0].y))
        .collect();
    crossings.sort_by(f64::total_cmp);
    crossings
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Pose;
    use glam::DVec3;

    use super::super::super::place::tests::place;
    use super::*;

    fn read(text: &str) -> Result<Vec<Polygon>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("heaps.geojson");
        fs::write(&path, text).unwrap();
        read_polygons(&path, &place()).map_err(|error| error.to_string())
    }

    fn feature(geometry: &str) -> String {
        format!(r#"{{"type": "Feature", "properties": {{"name": "A"}}, "geometry": {geometry}}}"#)
    }

    const RING: &str = "[[16.4, 53.3], [16.401, 53.3], [16.401, 53.301], [16.4, 53.3]]";

    #[test]
    fn polygons_are_read_with_their_names() {
        let one = read(&feature(&format!(r#"{{"type": "Polygon", "coordinates": [{RING}]}}"#))).unwrap();
        assert_eq!(one[0].name, "A");
        // Half of 66.7 m × 111.3 m.
        assert!((area(&one[0].rings) - 3712.0).abs() < 10.0, "{}", area(&one[0].rings));
        let two =
            read(&format!(r#"{{"type": "MultiPolygon", "coordinates": [[{RING}], [{RING}]]}}"#)).unwrap();
        assert_eq!(two[1].name, "polygon 1, part 2");
    }

    #[test]
    fn wrong_files_are_refused_with_a_reason() {
        let polygon = |ring: &str| feature(&format!(r#"{{"type": "Polygon", "coordinates": [{ring}]}}"#));
        for (text, told) in [
            ("{".to_string(), "not valid GeoJSON"),
            (r#"{"type": "FeatureCollection", "features": []}"#.into(), "no polygons"),
            (feature(r#"{"type": "Point", "coordinates": [16.4, 53.3]}"#), "A is not a polygon"),
            (feature(r#"{"type": "Polygon", "coordinates": []}"#), "A: has no ring"),
            (polygon("[[16.4, 53.3], [16.5, 53.3], [16.4, 53.3]]"), "A: a ring needs four"),
            (
                polygon("[[16.4, 153.3], [16.5, 53.3], [16.5, 53.4], [16.4, 153.3]]"),
                "longitude, then latitude",
            ),
            (
                polygon("[[16.4, 53.3], [16.401, 53.301], [16.401, 53.3], [16.4, 53.301], [16.4, 53.3]]"),
                "A: a ring crosses itself, after its positions 1 and 3",
            ),
        ] {
            let error = read(&text).unwrap_err();
            assert!(error.contains("heaps.geojson: ") && error.contains(told), "{error}");
        }
    }

    #[test]
    fn polygons_far_from_all_cameras_are_refused_before_the_work() {
        let polygons = read(&feature(&format!(r#"{{"type": "Polygon", "coordinates": [{RING}]}}"#))).unwrap();
        let camera = |east_m: f64| Camera {
            cam_from_world: Pose::look_at(DVec3::new(east_m, 0.0, 100.0), DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(100.0),
            center_px: DVec2::splat(50.0),
            size_px: [100, 100],
        };
        let check = |east_m: f64| {
            let cameras = [camera(east_m), camera(60_000.0)];
            check_near(&polygons, Path::new("heaps.geojson"), &cameras, &place())
        };
        check(400.0).unwrap();
        let error = check(50_000.0).unwrap_err().to_string();
        assert!(error.contains("heaps.geojson: A lies ") && error.contains("longitude, then"), "{error}");
    }

    #[test]
    fn rows_cross_rings_at_their_sides() {
        let ring: Vec<DVec2> =
            [[0.0, 0.0], [8.0, 0.0], [8.0, 4.0], [0.0, 4.0], [0.0, 0.0]].map(DVec2::from).to_vec();
        assert_eq!(crossings(std::slice::from_ref(&ring), 2.0), [0.0, 8.0]);
        assert_eq!(crossings(std::slice::from_ref(&ring), 4.5), Vec::<f64>::new());
        assert_eq!(along(&ring, [10, 10]).count(), 24);
        assert_eq!(middle(&ring), DVec2::new(4.0, 2.0));
    }
}
