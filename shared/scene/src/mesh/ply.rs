//! Meshes as PLY: `x y z [nx ny nz] [red green blue]` and `property list uchar int vertex_indices`,
//! which every mesh tool opens. Far from the world's origin, x, y and z are of the type `double`.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use glam::DVec3;

use super::data::{Mesh, MeshCounts};
use crate::error::Refusal;
use crate::ply::{Element, Kind, Rows, Scalar, read_elements};
use crate::{SceneError, atomic};

/// Coordinates of the type `double` whose first is at least so large are read relative to an origin: an `f32` of this
/// size is exact to half a millimetre.
const FAR: f64 = 8192.0;
/// The origin is a multiple of this.
const ORIGIN_STEP: f64 = 1000.0;

/// See [`Mesh::write_ply`].
pub(super) fn write(path: &Path, mesh: &Mesh) -> Result<(), SceneError> {
    write_parts(path, mesh, mesh.counts(), |writer| {
        writer.vertices(mesh)?;
        writer.triangles(&mesh.triangles)
    })
}

/// See [`Mesh::write_ply_parts`].
pub(super) fn write_parts<E: From<SceneError>>(
    path: &Path,
    kind: &Mesh,
    counts: MeshCounts,
    fill: impl FnOnce(&mut MeshWriter) -> Result<(), E>,
) -> Result<(), E> {
    let mut failed = None;
    let written = atomic::write(path, |out| {
        out.write_all(header_of(kind, counts).as_bytes())?;
        fill(&mut MeshWriter { out, path }).map_err(|error| {
            failed = Some(error);
            io::ErrorKind::Other.into()
        })
    });
    match failed {
        Some(error) => Err(error),
        None => Ok(written?),
    }
}

/// Writes a mesh part by part: see [`Mesh::write_ply_parts`].
pub struct MeshWriter<'a> {
    out: &'a mut BufWriter<File>,
    path: &'a Path,
}

impl MeshWriter<'_> {
    /// Writes the vertices of `part`, which follow those written before. Its triangles are ignored.
    pub fn vertices(&mut self, part: &Mesh) -> Result<(), SceneError> {
        let written = write_vertices(self.out, part);
        written.map_err(|cause| self.failed(cause))
    }

    /// Writes triangles, with the indices of their vertices in the whole mesh. All vertices must be written before.
    pub fn triangles(&mut self, triangles: &[[u32; 3]]) -> Result<(), SceneError> {
        let mut write = |corners: &[u32; 3]| {
            self.out.write_all(&[3])?;
            self.out.write_all(corners.map(u32::to_le_bytes).as_flattened())
        };
        triangles.iter().try_for_each(&mut write).map_err(|cause| self.failed(cause))
    }

    fn failed(&self, cause: io::Error) -> SceneError {
        SceneError::io(self.path, cause)
    }
}

fn write_vertices(out: &mut impl Write, part: &Mesh) -> io::Result<()> {
    let is_near = part.origin == DVec3::ZERO;
    for (i, position) in part.positions.iter().enumerate() {
        match is_near {
            true => out.write_all(position.map(f32::to_le_bytes).as_flattened())?,
            false => {
                let world = part.origin + DVec3::from_array(position.map(f64::from));
                out.write_all(world.to_array().map(f64::to_le_bytes).as_flattened())?;
            }
        }
        if let Some(normal) = part.normals.get(i) {
            out.write_all(normal.map(f32::to_le_bytes).as_flattened())?;
        }
        if let Some(rgb) = part.rgb.get(i) {
            out.write_all(rgb)?;
        }
    }
    Ok(())
}

/// The header of the file of a mesh with these counts, and with the origin and the properties of vertices of `kind`.
fn header_of(kind: &Mesh, MeshCounts { vertices, triangles }: MeshCounts) -> String {
    let mut text = format!("ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n");
    let mut declare = |kind: &str, names: [&str; 3]| {
        names.iter().for_each(|name| text += &format!("property {kind} {name}\n"));
    };
    declare(if kind.origin == DVec3::ZERO { "float" } else { "double" }, ["x", "y", "z"]);
    if !kind.normals.is_empty() {
        declare("float", ["nx", "ny", "nz"]);
    }
    if !kind.rgb.is_empty() {
        declare("uchar", ["red", "green", "blue"]);
    }
    if triangles > 0 {
        text += &format!("element face {triangles}\nproperty list uchar int vertex_indices\n");
    }
    text + "end_header\n"
}

/// See [`Mesh::read`].
pub(super) fn read(path: &Path) -> Result<Mesh, SceneError> {
    let mut mesh = Mesh::default();
    let mut has_vertices = false;
    read_elements(path, |element, rows| match element.name.as_str() {
        "vertex" => {
            has_vertices = true;
            read_vertices(element, rows, &mut mesh)
        }
        "face" => read_faces(element, rows, &mut mesh),
        _ => Ok(()),
    })?;
    check(&mesh, has_vertices).map_err(|refusal| refusal.of(path))?;
    Ok(mesh)
}

fn read_vertices(element: &Element, rows: &mut Rows, mesh: &mut Mesh) -> Result<(), Refusal> {
    let columns = |names: [&str; 3]| {
        let [a, b, c] = names.map(|name| element.column(name));
        Some([a?, b?, c?])
    };
    let position = columns(["x", "y", "z"]).ok_or("has no x, y and z for its vertices")?;
    let normal = columns(["nx", "ny", "nz"]);
    let rgb = columns(["red", "green", "blue"]);
    let is_double = position.iter().all(|&column| element.properties[column].kind == Kind::One(Scalar::F64));
    let rows_origin = rows.origin();
    mesh.origin = rows_origin;
    let count = element.count as usize;
    mesh.positions.reserve_exact(count);
    mesh.normals.reserve_exact(normal.map_or(0, |_| count));
    mesh.rgb.reserve_exact(rgb.map_or(0, |_| count));
    while let Some(row) = rows.next()? {
        let mut place = DVec3::from_array(position.map(|column| row[column]));
        if is_double && mesh.positions.is_empty() && place.abs().max_element() >= FAR {
            mesh.origin += (place / ORIGIN_STEP).round() * ORIGIN_STEP;
        }
        place -= mesh.origin - rows_origin;
        let p = place.as_vec3().to_array();
        if !p.iter().all(|v| v.is_finite()) {
            let vertex = mesh.positions.len();
            return Err(format!("vertex {vertex}: its position {p:?} is not finite; remove it").into());
        }
        mesh.positions.push(p);
        if let Some(columns) = normal {
            mesh.normals.push(unit_or_zero(columns.map(|column| row[column])));
        }
        if let Some(columns) = rgb {
            mesh.rgb.push(columns.map(|column| row[column] as u8));
        }
    }
    Ok(())
}

/// Normalises a normal; returns zero for one that is unusable. Other tools write NaN or zero for vertices
/// without faces.
fn unit_or_zero(normal: [f64; 3]) -> [f32; 3] {
    let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length.is_finite() && length > 1e-12 { normal.map(|v| (v / length) as f32) } else { [0.0; 3] }
}

fn read_faces(element: &Element, rows: &mut Rows, mesh: &mut Mesh) -> Result<(), Refusal> {
    let list_column = |name: &str| {
        element.properties.iter().position(|p| p.name == name && matches!(p.kind, Kind::List { .. }))
    };
    let column = list_column("vertex_indices")
        .or_else(|| list_column("vertex_index"))
        .ok_or("has no list vertex_indices for its faces")?;
    let mut face = Vec::new();
    // No memory is reserved for the triangles: an empty face takes only one byte, so a forged count of
    // faces could reserve too much.
    while rows.next_list(column, &mut face)? {
        let [first, rest @ ..] = face.as_slice() else {
            return Err("has a face without corners; remove the face".into());
        };
        if rest.len() < 2 {
            return Err(
                format!("has a face of {} corners, but a face needs three; remove it", face.len()).into()
            );
        }
        for pair in rest.windows(2) {
            mesh.triangles.push([index(*first)?, index(pair[0])?, index(pair[1])?]);
        }
    }
    Ok(())
}

fn index(value: f64) -> Result<u32, Refusal> {
    let index = value as u32;
    if f64::from(index) == value { Ok(index) } else { Err(format!("{value} is not a vertex index").into()) }
}

fn check(mesh: &Mesh, has_vertices: bool) -> Result<(), Refusal> {
    if !has_vertices {
        return Err("has no element called vertex".into());
    }
    let vertices = mesh.positions.len();
    let out_of_range = |triangle: &&[u32; 3]| triangle.iter().any(|&vertex| vertex as usize >= vertices);
    match mesh.triangles.iter().find(out_of_range) {
        Some(triangle) => Err(format!("has a triangle with the vertex indices {triangle:?}, but only {vertices} vertices; the file is damaged or forged").into()),
        None => Ok(()),
    }
}
