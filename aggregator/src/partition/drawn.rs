//! Reads hand-drawn cells, the areas of the agents, from a GeoJSON file. Map programs can write this format.

use std::fs;
use std::path::Path;

use cosurf_scene::SceneError;
use serde::Deserialize;

/// A cell as it was drawn. Its polygon is not checked.
#[derive(Clone, Debug, PartialEq)]
pub struct DrawnCell {
    /// The corners in map coordinates.
    pub corners: Vec<[f64; 2]>,
    /// The property `device`: the name of the drone that observes the cell.
    pub device: Option<String>,
}

/// The parts of GeoJSON (RFC 7946) that are read. Other members of these objects are ignored.
#[derive(Deserialize)]
#[serde(tag = "type")]
enum GeoJson {
    FeatureCollection {
        features: Vec<GeoJson>,
    },
    Feature {
        geometry: Option<Box<GeoJson>>,
        properties: Option<Properties>,
    },
    /// `coordinates` is a list of rings of positions: first the outer border, then the holes.
    Polygon {
        coordinates: Vec<Vec<Vec<f64>>>,
    },
    #[serde(other)]
    Other,
}

/// The properties of a cell. Other ones are ignored.
#[derive(Deserialize)]
struct Properties {
    device: Option<String>,
}

/// Reads the polygons of a file, in file order. Fails if a polygon has a hole, or if the file has another geometry.
pub fn read_cells(file: &Path) -> Result<Vec<DrawnCell>, SceneError> {
    let text = fs::read_to_string(file).map_err(|cause| SceneError::io(file, cause))?;
    parse(&text).map_err(|reason| SceneError::malformed(file, reason))
}

fn parse(text: &str) -> Result<Vec<DrawnCell>, String> {
    let mut cells = Vec::new();
    let json = serde_json::from_str(text).map_err(|error| format!("not valid GeoJSON: {error}"))?;
    collect(json, None, &mut cells)?;
    Ok(cells)
}

/// Adds the cells in `part`, which are for `device`.
fn collect(part: GeoJson, device: Option<String>, cells: &mut Vec<DrawnCell>) -> Result<(), String> {
    let number = cells.len() + 1;
    match part {
        GeoJson::FeatureCollection { features } => {
            features.into_iter().try_for_each(|feature| collect(feature, None, cells))
        }
        GeoJson::Feature { geometry: Some(geometry), properties } => {
            collect(*geometry, properties.and_then(|properties| properties.device), cells)
        }
        GeoJson::Polygon { coordinates } if coordinates.len() == 1 => {
            let corner = |position: &Vec<f64>| match position[..] {
                [x, y, ..] => Ok([x, y]),
                _ => Err(format!("cell {number}: a position needs two coordinates")),
            };
            let corners = coordinates[0].iter().map(corner).collect::<Result<_, _>>()?;
            cells.push(DrawnCell { corners, device });
            Ok(())
        }
        _ => Err(format!("cell {number} is not a polygon without holes: draw one polygon per cell")),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn polygons_and_their_devices_are_read_and_heights_ignored() {
        let text = r#"{"type":"FeatureCollection","name":"cells","features":[
            {"type":"Feature","properties":{"id":1,"device":"drone-1"},"geometry":{"type":"Polygon","coordinates":[[[0,0],[9,0,5.5],[9,9]]]}},
            {"type":"Feature","properties":null,"geometry":{"type":"Polygon","coordinates":[[[1,2],[3,4],[5,7]]]}}]}"#;
        let corners = [vec![[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]], vec![[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]]];
        let [first, second] = corners;
        let cells = [(first, Some("drone-1".to_owned())), (second, None)];
        assert_eq!(parse(text).unwrap(), cells.map(|(corners, device)| DrawnCell { corners, device }));
    }

    #[test]
    fn an_invalid_cell_is_refused_with_its_number() {
        for (text, what) in [
            ("{", "not valid GeoJSON"),
            (r#"{"type":"Point","coordinates":[0,0]}"#, "cell 1 is not a polygon"),
            (r#"{"type":"Feature","geometry":null,"properties":{"device":7}}"#, "expected a string"),
            (r#"{"type":"Polygon","coordinates":[[[0]]]}"#, "two coordinates"),
            (r#"{"type":"Polygon","coordinates":[[[0,0]],[[0,0]]]}"#, "without holes"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.contains(what), "{error}");
        }
    }
}
