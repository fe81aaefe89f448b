//! Wavefront OBJ: text that every mesh tool reads. Colours follow the positions, as MeshLab and Blender read them
//! ("v x y z r g b", colours from 0 to 1); the format itself has none.

use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;

use super::data::Mesh;
use crate::{SceneError, atomic};

/// Writes the mesh, with a comment of one line.
pub(super) fn write(path: &Path, mesh: &Mesh, comment: &str) -> Result<(), SceneError> {
    atomic::write(path, |out| {
        writeln!(out, "# {comment}")?;
        for (i, position) in mesh.positions.iter().enumerate() {
            write!(out, "v {}", coordinates(*position, mesh.origin))?;
            if let Some(rgb) = mesh.rgb.get(i) {
                let [r, g, b] = rgb.map(|value| f32::from(value) / 255.0);
                write!(out, " {r:.4} {g:.4} {b:.4}")?;
            }
            writeln!(out)?;
        }
        mesh.normals.iter().try_for_each(|[x, y, z]| writeln!(out, "vn {x:.4} {y:.4} {z:.4}"))?;
        mesh.triangles.iter().try_for_each(|triangle| write_face(out, *triangle, !mesh.normals.is_empty()))
    })
}

/// Numbers as short as the precision allows: all digits of an `f32`, or tenths of a millimetre far from the origin.
fn coordinates(position: [f32; 3], origin: DVec3) -> String {
    if origin == DVec3::ZERO {
        let [x, y, z] = position;
        return format!("{x} {y} {z}");
    }
    let DVec3 { x, y, z } = origin + DVec3::from_array(position.map(f64::from));
    format!("{x:.4} {y:.4} {z:.4}")
}

/// Vertices are counted from 1.
fn write_face(out: &mut impl Write, triangle: [u32; 3], has_normals: bool) -> io::Result<()> {
    let [a, b, c] = triangle.map(|vertex| u64::from(vertex) + 1);
    match has_normals {
        true => writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}"),
        false => writeln!(out, "f {a} {b} {c}"),
    }
}
