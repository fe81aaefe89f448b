//! Lines of equal height, by marching squares, as GeoJSON (RFC 7946: longitude and latitude, WGS 84).
//!
//! Heights are first averaged over cells whose side is a quarter of the difference between contours, because noise of a
//! few centimetres would fray lines that are a metre apart.
//!
//! What it knows nothing about: where heights come from.
//!
//! Where to start reading: [`write_contours`], then [`trace()`].

mod grid;
mod trace;

use std::io;
use std::path::Path;

use cosurf_geo::GeoError;
use cosurf_scene::{SceneError, atomic};
use geojson::{Feature, FeatureWriter, Geometry, GeometryValue, JsonObject, Position};

use super::error::SurveyError;
use super::lattice::{Lattice, two_digits_up};
use super::tiles::Tiles;
use grid::Grid;
use trace::{Line, trace};

/// Cells per difference of height between contours.
const CELLS_PER_STEP: f64 = 4.0;
/// Largest number of contours one above the other.
const LEVELS_MAX: f64 = 2000.0;
/// Longitudes and latitudes are rounded to a multiple of this, degrees: 1 mm on the ground.
const STEP_DEG: f64 = 1e-8;

/// Writes the contours at all multiples of `step_m` (above 0) between the heights of `range_m`, metres.
pub(super) fn write_contours(
    path: &Path,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
    step_m: f64,
    range_m: [f64; 2],
) -> Result<(), SurveyError> {
    let levels = (range_m[1] - range_m[0]) / step_m;
    if levels > LEVELS_MAX {
        let enough_m = two_digits_up((range_m[1] - range_m[0]) / LEVELS_MAX);
        return Err(SurveyError::TooManyContours { step_m, range_m, enough_m });
    }
    let cell_px = (step_m / CELLS_PER_STEP / lattice.gsd_m()).round().clamp(1.0, 1e6) as u32;
    let grid = Grid::of(heights, lattice.size_px(), cell_px)?;
    let features: Vec<Feature> =
        trace(&grid, step_m).iter().map(|line| feature(line, lattice, step_m)).collect::<Result<_, _>>()?;
    atomic::write(path, |file| {
        let mut writer = FeatureWriter::from_writer(file);
        features
            .iter()
            .try_for_each(|feature| writer.write_feature(feature))
            .and_then(|()| writer.finish())
            .map_err(io::Error::other)
    })
    .map_err(SceneError::into)
}

fn feature(line: &Line, lattice: &Lattice, step_m: f64) -> Result<Feature, GeoError> {
    let position = |px: &glam::DVec2| {
        let degrees = lattice.place().degrees_from_map(lattice.map_from_px(*px))?;
        Ok(Position::from(degrees.map(|degrees| (degrees / STEP_DEG).round() / (1.0 / STEP_DEG))))
    };
    let coordinates = line.points_px.iter().map(position).collect::<Result<Vec<_>, GeoError>>()?;
    let mut properties = JsonObject::new();
    properties.insert("height_m".into(), serde_json::json!(line.level as f64 * step_m));
    Ok(Feature {
        bbox: None,
        geometry: Some(Geometry::new(GeometryValue::LineString { coordinates })),
        id: None,
        properties: Some(properties),
        foreign_members: None,
    })
}
