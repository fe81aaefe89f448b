//! Lines of equal height, by marching squares, as GeoJSON (RFC 7946: longitude and latitude, WGS 84).
//!
//! Heights are first averaged over cells whose side is a quarter of the difference between contours, because noise of a
//! few centimetres would fray lines that are a metre apart.
//!
//! What it knows nothing about: where heights come from.
//!
//! Where to start reading: [`write_contours`], then [`trace()`].

mod trace;

use std::io;
use std::path::Path;

use cosurf_geo::GeoError;
use cosurf_scene::atomic;
use geojson::{Feature, FeatureWriter, Geometry, GeometryValue, JsonObject, Position};

use super::error::SurveyError;
use super::grid::Grid;
use super::lattice::{Lattice, two_digits_up};
use super::tiles::Tiles;
use trace::{Line, trace};

/// Cells per difference of height between contours.
const CELLS_PER_STEP: f64 = 4.0;
/// Largest number of contours one above the other.
const LEVELS_MAX: f64 = 2000.0;
/// Longitudes and latitudes are rounded to a multiple of this, degrees: 1 mm on the ground.
const STEP_DEG: f64 = 1e-8;

/// Which contours are wanted.
#[derive(Clone, Copy, Debug)]
pub(super) struct ContourOrder {
    /// Difference of height between two contours, metres, above 0.
    pub(super) step_m: f64,
    /// Lowest and highest height, metres.
    pub(super) range_m: [f64; 2],
    /// Limit on the memory of the process, bytes.
    pub(super) memory_bytes: u64,
}

/// Writes the contours at all multiples of the step between the lowest and the highest height.
pub(super) fn write_contours(
    path: &Path,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
    order: &ContourOrder,
) -> Result<(), SurveyError> {
    let ContourOrder { step_m, range_m, memory_bytes } = *order;
    let levels = (range_m[1] - range_m[0]) / step_m;
    if levels > LEVELS_MAX {
        let enough_m = two_digits_up((range_m[1] - range_m[0]) / LEVELS_MAX);
        return Err(SurveyError::TooManyContours { step_m, range_m, enough_m });
    }
    let cell_px = (step_m / CELLS_PER_STEP / lattice.gsd_m()).round().clamp(1.0, 1e6) as u32;
    let grid = Grid::of(heights, cell_px, memory_bytes)?;
    let mut outside: Option<GeoError> = None;
    atomic::write(path, |file| {
        let mut writer = FeatureWriter::from_writer(file);
        for line in trace(&grid, step_m) {
            let feature = feature(&line, lattice, step_m).map_err(|error| {
                outside = Some(error);
                io::Error::other("outside of the coordinate system")
            })?;
            writer.write_feature(&feature).map_err(io::Error::other)?;
        }
        writer.finish().map_err(io::Error::other)
    })
    .map_err(|error| outside.map_or_else(|| SurveyError::from(error), SurveyError::from))
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
