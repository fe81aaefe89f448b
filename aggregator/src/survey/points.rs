//! The surface as a cloud of points in a COPC file: a LAZ file whose points lie in an octree, so that programs read only
//! the part and the detail that they show.
//!
//! The points are the vertices of the mesh, not the cells of the map: those would only repeat the heights, and have no
//! points on walls and below roofs. The file is LAS 1.4 with points of format 7, the plainest that has colours and whose
//! coordinate system is told as WKT, as the specification (COPC 1.0) wants.
//!
//! The vertices wait in a file until it is known which heights of the map can be trusted: where there is none, their heights
//! cannot be trusted either.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use bytemuck::{Pod, Zeroable};
use copc_core::Bounds;
use copc_writer::{CopcPointFields, CopcPointSource, CopcWriteMetadata, CopcWriterParams, write_source};
use cosurf_scene::{LocalFrame, Mesh, SceneError, atomic};
use glam::{DVec2, DVec3};

use super::error::SurveyError;
use super::lattice::Lattice;
use super::place::Place;
use super::tiles::Tiles;

/// Coordinates are multiples of this, metres. A millimetre reaches 2,000 km in 32 bits.
const STEP_M: f64 = 0.001;
/// Offsets of coordinates are multiples of this, metres, so that files of one site have the same.
const OFFSET_STEP_M: f64 = 1000.0;

/// Begin and end of the names of files that the library leaves if it is killed.
const LEFT_BEHIND: [&str; 2] = ["..points", ".part"];

/// Removes what a survey that was killed has left in a folder.
pub(super) fn remove_leftovers(folder: &Path) -> Result<(), SceneError> {
    let io = |cause| SceneError::io(folder, cause);
    for entry in fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let (name, [begin, end]) = (entry.file_name(), LEFT_BEHIND);
        let is_left = name.to_str().is_some_and(|name| name.starts_with(begin) && name.ends_with(end));
        if is_left && entry.file_type().is_ok_and(|kind| kind.is_file()) {
            fs::remove_file(entry.path()).map_err(|cause| SceneError::io(&entry.path(), cause))?;
        }
    }
    Ok(())
}

/// A point in the coordinate system.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
struct Point {
    /// Easting, northing and height, multiples of [`STEP_M`] from the offset.
    at: [i32; 3],
    rgb: [u8; 3],
    unused: u8,
}

/// Points in the coordinate system.
#[derive(Debug)]
pub(super) struct Points {
    points: Vec<Point>,
    offset: DVec3,
}

/// Points in a file without a name.
#[derive(Debug)]
pub(super) struct StoredPoints {
    file: File,
    /// The folder that the file is in, for errors.
    folder: PathBuf,
    count: usize,
    offset: DVec3,
}

impl StoredPoints {
    /// Reads them back.
    pub(super) fn read(mut self) -> Result<Points, SurveyError> {
        let mut points = vec![Point::zeroed(); self.count];
        let bytes = bytemuck::cast_slice_mut(&mut points);
        let read = self.file.seek(SeekFrom::Start(0)).and_then(|_| self.file.read_exact(bytes));
        read.map_err(|cause| SceneError::io(&self.folder, cause))?;
        Ok(Points { points, offset: self.offset })
    }
}

impl Points {
    /// The vertices that enough cameras see.
    pub(super) fn of(
        mesh: &Mesh,
        is_seen: &[bool],
        place: &Place,
        frame: &LocalFrame,
    ) -> Result<Self, SurveyError> {
        let vertices = || (0..mesh.positions.len()).filter(|vertex| is_seen[*vertex]);
        let map = |vertex: usize| {
            let local = mesh.positions[vertex].map(f64::from);
            place.map_from_enu(frame.world_from_local(local.into()))
        };
        let first = map(vertices().next().ok_or(SurveyError::NothingSeen)?)?;
        let offset = (first / OFFSET_STEP_M).floor() * OFFSET_STEP_M;
        let mut points = Vec::with_capacity(vertices().count());
        for vertex in vertices() {
            let at = ((map(vertex)? - offset) / STEP_M).round().to_array().map(|steps| steps as i32);
            points.push(Point { at, rgb: mesh.rgb.get(vertex).copied().unwrap_or_default(), unused: 0 });
        }
        Ok(Self { points, offset })
    }

    /// Puts them into a file on the disk of `folder`.
    pub(super) fn store(self, folder: &Path) -> Result<StoredPoints, SceneError> {
        let io = |cause| SceneError::io(folder, cause);
        let mut file = tempfile::tempfile_in(folder).map_err(io)?;
        file.write_all(bytemuck::cast_slice(&self.points)).map_err(io)?;
        Ok(StoredPoints { file, folder: folder.into(), count: self.points.len(), offset: self.offset })
    }

    /// Those at whose pixel of the map there is a height.
    pub(super) fn trusted(
        mut self,
        lattice: &Lattice,
        heights: &mut Tiles<f32>,
    ) -> Result<Self, SurveyError> {
        let most = heights.size_px().map(|side| side - 1);
        // The last point of the map may lie on its edge.
        let pixel = |point: usize| {
            let px = lattice.px_from_map(self.at(point).truncate()).max(DVec2::ZERO);
            [(px.x as u32).min(most[0]), (px.y as u32).min(most[1])]
        };
        let mut order: Vec<(u32, u32)> =
            (0..self.points.len()).map(|i| (heights.tile_of(pixel(i)) as u32, i as u32)).collect();
        order.sort_unstable();
        let mut kept = Vec::with_capacity(order.len());
        for group in order.chunk_by(|a, b| a.0 == b.0) {
            let (window, values) = (heights.window(group[0].0 as usize), heights.read(group[0].0 as usize)?);
            kept.extend(group.iter().map(|(_, point)| *point).filter(|point| {
                let [x, y] = pixel(*point as usize);
                !values[((y - window.at[1]) * window.size[0] + x - window.at[0]) as usize].is_nan()
            }));
        }
        kept.sort_unstable();
        self.points = kept.into_iter().map(|point| self.points[point as usize]).collect();
        Ok(self)
    }

    /// Writes them, and returns how many they are. At least one is needed.
    pub(super) fn write(&self, path: &Path, place: &Place) -> Result<u64, SurveyError> {
        if self.points.is_empty() {
            return Err(SurveyError::NothingSeen);
        }
        // The library wants a path. A file that a kill leaves behind has a name that the next run removes.
        let folder = path.parent().unwrap_or(Path::new("."));
        let temporary = tempfile::Builder::new()
            .prefix(".points")
            .suffix(".partial")
            .tempfile_in(folder)
            .map_err(|cause| SceneError::io(folder, cause))?;
        let parameters = CopcWriterParams::default();
        write_source(temporary.path(), self, true, self.bounds(), &parameters, &self.metadata(place))
            .map_err(|error| SceneError::io(path, io::Error::other(error)))?;
        atomic::write(path, |file| io::copy(&mut File::open(temporary.path())?, file).map(drop))?;
        Ok(self.points.len() as u64)
    }

    fn at(&self, index: usize) -> DVec3 {
        self.offset + DVec3::from_array(self.points[index].at.map(f64::from)) * STEP_M
    }

    fn bounds(&self) -> Bounds {
        let tuple = |at: DVec3| (at.x, at.y, at.z);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for index in 0..self.points.len() {
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

impl CopcPointSource for Points {
    fn len(&self) -> usize {
        self.points.len()
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
        [out.red, out.green, out.blue] = self.points[index].rgb.map(|value| u16::from(value) * 257);
        Ok(())
    }
}
