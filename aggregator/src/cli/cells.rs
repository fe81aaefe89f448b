//! Reads hand-drawn cells, the areas of the agents, from a GeoJSON file. Map programs can write this format.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, bail};
use cosurf_aggregator::partition::Division;
use cosurf_scene::SceneError;
use serde::Deserialize;

/// The parts of GeoJSON (RFC 7946) that are read. Other members of these objects, such as names, are ignored.
#[derive(Deserialize)]
#[serde(tag = "type")]
enum GeoJson {
    FeatureCollection {
        features: Vec<GeoJson>,
    },
    Feature {
        geometry: Option<Box<GeoJson>>,
    },
    /// `coordinates` is a list of rings of positions: first the outer border, then the holes.
    Polygon {
        coordinates: Vec<Vec<Vec<f64>>>,
    },
    #[serde(other)]
    Other,
}

/// Reads the polygons of a file, in file order. Fails if a polygon has a hole, or if the file has another geometry.
pub(super) fn read(file: &Path) -> Result<Division> {
    let text = fs::read_to_string(file).map_err(|cause| SceneError::io(file, cause)).context("--cells")?;
    parse(&text).with_context(|| format!("--cells {}", file.display()))
}

fn parse(text: &str) -> Result<Division> {
    let mut polygons = Vec::new();
    collect(serde_json::from_str(text).context("not valid GeoJSON")?, &mut polygons)?;
    Ok(Division::Polygons(polygons))
}

fn collect(part: GeoJson, polygons: &mut Vec<Vec<[f64; 2]>>) -> Result<()> {
    match part {
        GeoJson::FeatureCollection { features } => {
            features.into_iter().try_for_each(|feature| collect(feature, polygons))
        }
        GeoJson::Feature { geometry: Some(geometry) } => collect(*geometry, polygons),
        GeoJson::Polygon { coordinates } if coordinates.len() == 1 => {
            let corner = |position: &Vec<f64>| match position[..] {
                [x, y, ..] => Ok([x, y]),
                _ => bail!("cell {}: a position needs two coordinates", polygons.len() + 1),
            };
            let corners = coordinates[0].iter().map(corner).collect::<Result<_>>()?;
            polygons.push(corners);
            Ok(())
        }
        _ => bail!("cell {} is not a polygon without holes: draw one polygon per cell", polygons.len() + 1),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn polygons_are_read_and_heights_and_names_ignored() {
        let text = r#"{"type":"FeatureCollection","name":"cells","features":[
            {"type":"Feature","properties":{"id":1},"geometry":{"type":"Polygon","coordinates":[[[0,0],[9,0,5.5],[9,9]]]}},
            {"type":"Feature","properties":null,"geometry":{"type":"Polygon","coordinates":[[[1,2],[3,4],[5,7]]]}}]}"#;
        let polygons =
            vec![vec![[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]], vec![[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]]];
        assert_eq!(parse(text).unwrap(), Division::Polygons(polygons));
    }

    #[test]
    fn an_invalid_cell_is_refused_with_its_number() {
        for (text, what) in [
            ("{", "not valid GeoJSON"),
            (r#"{"type":"Point","coordinates":[0,0]}"#, "cell 1 is not a polygon"),
            (r#"{"type":"Polygon","coordinates":[[[0]]]}"#, "two coordinates"),
            (r#"{"type":"Polygon","coordinates":[[[0,0]],[[0,0]]]}"#, "without holes"),
        ] {
            let error = format!("{:#}", parse(text).unwrap_err());
            assert!(error.contains(what), "{error}");
        }
    }
}
