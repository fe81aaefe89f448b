//! The surface as a cloud of points in a COPC file: a LAZ file whose points lie in an octree, so that programs read only
//! the part and the detail that they show.
//!
//! The points are the vertices of the mesh, not the cells of the map: those would only repeat the heights, and have no
//! points on walls and below roofs. The file is LAS 1.4 with points of format 7, the plainest that has colours and whose
//! coordinate system is told as WKT, as the specification (COPC 1.0) wants.
//!
//! What it knows nothing about: pixels of maps.

use std::fs::File;
use std::io;
use std::path::Path;

use copc_core::Bounds;
use copc_writer::{CopcPointFields, CopcPointSource, CopcWriteMetadata, CopcWriterParams, write_source};
use cosurf_scene::{LocalFrame, Mesh, SceneError, atomic};
use glam::DVec3;

use super::error::SurveyError;
use super::place::Place;

/// Coordinates are multiples of this, metres. A millimetre reaches 2,000 km in 32 bits.
const STEP_M: f64 = 0.001;
/// Offsets of coordinates are multiples of this, metres, so that files of one site have the same.
const OFFSET_STEP_M: f64 = 1000.0;

/// Writes the vertices that enough cameras see, and returns how many.
pub(super) fn write_points(
    path: &Path,
    mesh: &Mesh,
    is_seen: &[bool],
    place: &Place,
    frame: &LocalFrame,
) -> Result<u64, SurveyError> {
    let points = Points::of(mesh, is_seen, place, frame)?;
    // The library wants a path. A file that a kill leaves behind has a name that the next run removes.
    let folder = path.parent().unwrap_or(Path::new("."));
    let temporary = tempfile::Builder::new()
        .prefix(".points")
        .suffix(".partial")
        .tempfile_in(folder)
        .map_err(|cause| SceneError::io(folder, cause))?;
    let parameters = CopcWriterParams::default();
    write_source(temporary.path(), &points, true, points.bounds(), &parameters, &points.metadata(place))
        .map_err(|error| SceneError::io(path, io::Error::other(error)))?;
    atomic::write(path, |file| io::copy(&mut File::open(temporary.path())?, file).map(drop))?;
    Ok(points.len() as u64)
}

/// The points in the coordinate system.
struct Points<'a> {
    mesh: &'a Mesh,
    /// Their vertices.
    vertices: Vec<u32>,
    /// Easting, northing and height, multiples of [`STEP_M`] from the offset.
    at: Vec<[i32; 3]>,
    offset: DVec3,
}

impl<'a> Points<'a> {
    fn of(mesh: &'a Mesh, is_seen: &[bool], place: &Place, frame: &LocalFrame) -> Result<Self, SurveyError> {
        let vertices: Vec<u32> =
            (0..mesh.positions.len() as u32).filter(|vertex| is_seen[*vertex as usize]).collect();
        let map = |vertex: u32| {
            let local = mesh.positions[vertex as usize].map(f64::from);
            place.map_from_enu(frame.world_from_local(local.into()))
        };
        let first = map(*vertices.first().ok_or(SurveyError::NothingSeen)?)?;
        let offset = (first / OFFSET_STEP_M).floor() * OFFSET_STEP_M;
        let mut at = Vec::with_capacity(vertices.len());
        for vertex in &vertices {
            at.push(((map(*vertex)? - offset) / STEP_M).round().to_array().map(|steps| steps as i32));
        }
        Ok(Self { mesh, vertices, at, offset })
    }

    fn at(&self, index: usize) -> DVec3 {
        self.offset + DVec3::from_array(self.at[index].map(f64::from)) * STEP_M
    }

    fn bounds(&self) -> Bounds {
        let tuple = |at: DVec3| (at.x, at.y, at.z);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for index in 0..self.at.len() {
            (low, high) = (low.min(self.at(index)), high.max(self.at(index)));
        }
        Bounds::new(tuple(low), tuple(high))
    }

    fn metadata(&self, place: &Place) -> CopcWriteMetadata {
        let mut metadata = CopcWriteMetadata::default();
        metadata.wkt_crs = Some(place.wkt());
        metadata.system_identifier = Some("Gaussian splats".into());
        metadata.generating_software = Some(concat!("cosurf ", env!("CARGO_PKG_VERSION")).into());
        metadata.scale = Some((STEP_M, STEP_M, STEP_M));
        metadata.offset = Some((self.offset.x, self.offset.y, self.offset.z));
        metadata
    }
}

impl CopcPointSource for Points<'_> {
    fn len(&self) -> usize {
        self.vertices.len()
    }

    fn xyz(&self, index: usize) -> copc_core::Result<(f64, f64, f64)> {
        let at = self.at(index);
        Ok((at.x, at.y, at.z))
    }

    fn fields_into(&self, index: usize, out: &mut CopcPointFields) -> copc_core::Result<()> {
        let at = self.at(index);
        (out.x, out.y, out.z) = (at.x, at.y, at.z);
        (out.return_number, out.number_of_returns) = (1, 1);
        // 8 bits become 16 as the specification wants: 255 becomes 65,535.
        let rgb = self.mesh.rgb.get(self.vertices[index] as usize).copied().unwrap_or_default();
        [out.red, out.green, out.blue] = rgb.map(|value| u16::from(value) * 257);
        Ok(())
    }
}
