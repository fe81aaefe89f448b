//! The surface as a cloud of points in a LAZ file.
//!
//! The points are the vertices of the mesh, not the cells of the map: those would only repeat the heights, and have no
//! points on walls and below roofs. The file is LAS 1.4 with points of format 7, the plainest that has colours and whose
//! coordinate system is told as WKT, as the specification (ASPRS, LAS 1.4 R15) wants.
//!
//! What it knows nothing about: pixels of maps.

use std::io::{self, BufWriter};
use std::path::Path;

use cosurf_geo::GeoError;
use cosurf_scene::{LocalFrame, Mesh, SceneError, atomic};
use glam::DVec3;
use las::point::Format;
use las::{Builder, Color, Header, Point, Transform, Vector, Writer};

use super::error::SurveyError;
use super::heights::Surface;
use super::place::Place;

/// Coordinates are multiples of this, metres. A millimetre reaches 2,000 km in 32 bits.
const STEP_M: f64 = 0.001;
/// Number of the point format with colours.
const FORMAT_WITH_COLORS: u8 = 7;
/// Offsets of coordinates are multiples of this, metres, so that files of one site have the same.
const OFFSET_STEP_M: f64 = 1000.0;

/// Writes the vertices that enough cameras see, and returns how many. The mesh is the one that the surface was made of.
pub(super) fn write_points(
    path: &Path,
    mesh: &Mesh,
    surface: &Surface,
    place: &Place,
    frame: &LocalFrame,
) -> Result<u64, SurveyError> {
    let first = place.map_from_enu(surface.seen.places.first().copied().unwrap_or_default())?;
    let header = header(place, first).map_err(|error| SceneError::malformed(path, error.to_string()))?;
    let mut count = 0;
    let mut outside: Option<GeoError> = None;
    atomic::write(path, |file| {
        // The writer wants a file of its own; both have the same place in it.
        let own = BufWriter::new(file.get_ref().try_clone()?);
        let mut writer = Writer::new(own, header).map_err(io::Error::other)?;
        for vertex in (0..mesh.positions.len()).filter(|vertex| surface.is_seen[*vertex]) {
            let local = DVec3::from_array(mesh.positions[vertex].map(f64::from));
            let at = match place.map_from_enu(frame.world_from_local(local)) {
                Ok(at) => at,
                Err(error) => {
                    outside = Some(error);
                    return Err(io::Error::other("outside of the coordinate system"));
                }
            };
            writer.write_point(point(at, mesh.rgb.get(vertex).copied())).map_err(io::Error::other)?;
            count += 1;
        }
        writer.close().map_err(io::Error::other)
    })
    .map_err(|error| outside.map_or_else(|| SurveyError::from(error), SurveyError::from))?;
    Ok(count)
}

fn header(place: &Place, first: DVec3) -> las::Result<Header> {
    let mut builder = Builder::from((1, 4));
    builder.point_format = Format::new(FORMAT_WITH_COLORS)?;
    builder.point_format.is_compressed = true;
    builder.generating_software = concat!("cosurf ", env!("CARGO_PKG_VERSION")).into();
    builder.system_identifier = "Gaussian splats".into();
    let transform =
        |value: f64| Transform { scale: STEP_M, offset: (value / OFFSET_STEP_M).floor() * OFFSET_STEP_M };
    builder.transforms = Vector { x: transform(first.x), y: transform(first.y), z: transform(first.z) };
    let mut header = builder.into_header()?;
    header.set_wkt_crs(place.projection().wkt().as_bytes().to_vec())?;
    Ok(header)
}

fn point(at: DVec3, rgb: Option<[u8; 3]>) -> Point {
    // 8 bits become 16 as the specification wants: 255 becomes 65,535.
    let [red, green, blue] = rgb.unwrap_or_default().map(|value| u16::from(value) * 257);
    Point {
        x: at.x,
        y: at.y,
        z: at.z,
        return_number: 1,
        number_of_returns: 1,
        color: Some(Color { red, green, blue }),
        gps_time: Some(0.0),
        ..Point::default()
    }
}
