//! Polygons of a GeoJSON file (RFC 7946: longitude and latitude, WGS 84).
//!
//! What it knows nothing about: heights.

use std::fs;
use std::path::Path;

use cosurf_scene::SceneError;
use cosurf_scene::bytes::format_bytes;
use geojson::{Feature, GeoJson, GeometryValue, Position};
use glam::DVec2;

use crate::survey::error::SurveyError;
use crate::survey::place::Place;

/// Largest file, bytes.
const FILE_BYTES_MAX: u64 = 64 << 20;

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
    let corner = |position: &Position| match position.as_slice() {
        [longitude, latitude, ..] => {
            place.map_from_degrees(*longitude, *latitude).map_err(|error| error.to_string())
        }
        _ => Err("a position needs longitude and latitude".to_string()),
    };
    let corners: Vec<DVec2> = ring.iter().map(corner).collect::<Result<_, _>>()?;
    if corners.len() < 4 || corners.first() != corners.last() {
        return Err("a ring needs four positions, of which the last is the first again".into());
    }
    Ok(corners)
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
            (polygon("[[16.4, 153.3], [16.5, 53.3], [16.5, 53.4], [16.4, 153.3]]"), "no place on the earth"),
        ] {
            let error = read(&text).unwrap_err();
            assert!(error.contains("heaps.geojson: ") && error.contains(told), "{error}");
        }
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
