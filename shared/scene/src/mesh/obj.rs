//! Wavefront OBJ: text that every mesh tool reads. Colours follow the positions, as MeshLab and Blender read them
//! ("v x y z r g b", colours from 0 to 1); the format itself has none. A texture is a picture beside the text, named in a
//! file of materials.

use std::borrow::Cow;
use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;

use super::data::Mesh;
use super::texture::Texture;
use crate::{SceneError, atomic};

/// Name of the material.
const MATERIAL: &str = "surface";

/// Writes the mesh, with a comment of one line. With a texture, its material is in the file beside it that
/// [`write_material`] writes, and vertices have no colours: some viewers multiply both.
pub(super) fn write(
    path: &Path,
    mesh: &Mesh,
    texture: Option<&Texture>,
    comment: &str,
) -> Result<(), SceneError> {
    let rgb = if texture.is_some() { &[][..] } else { &mesh.rgb };
    atomic::write(path, |out| {
        writeln!(out, "# {comment}")?;
        if texture.is_some() {
            writeln!(out, "mtllib {}\nusemtl {MATERIAL}", name(&path.with_extension("mtl")))?;
        }
        for (i, position) in mesh.positions.iter().enumerate() {
            write!(out, "v {}", coordinates(*position, mesh.origin))?;
            if let Some(rgb) = rgb.get(i) {
                let [r, g, b] = rgb.map(|value| f32::from(value) / 255.0);
                write!(out, " {r:.4} {g:.4} {b:.4}")?;
            }
            writeln!(out)?;
        }
        mesh.normals.iter().try_for_each(|[x, y, z]| writeln!(out, "vn {x:.4} {y:.4} {z:.4}"))?;
        // The format counts from the lower edge.
        let uv = texture.iter().flat_map(|texture| &texture.uv);
        uv.into_iter().try_for_each(|[u, v]| writeln!(out, "vt {u:.6} {:.6}", 1.0 - v))?;
        let has = [texture.is_some(), !mesh.normals.is_empty()];
        mesh.triangles.iter().try_for_each(|triangle| write_face(out, *triangle, has))
    })
}

/// Writes the file of materials: the picture as it is, without lights.
pub(super) fn write_material(path: &Path, texture: &Texture) -> Result<(), SceneError> {
    let picture = name(&texture.picture);
    let text = format!("newmtl {MATERIAL}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 0\nmap_Kd {picture}\n");
    atomic::write_bytes(path, text.as_bytes())
}

/// Name of a file in its folder.
fn name(path: &Path) -> Cow<'_, str> {
    path.file_name().map_or(Cow::Borrowed(""), |name| name.to_string_lossy())
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

/// Vertices are counted from 1. `has` tells whether they have a place on a picture, and a normal.
fn write_face(out: &mut impl Write, triangle: [u32; 3], has: [bool; 2]) -> io::Result<()> {
    let [a, b, c] = triangle.map(|vertex| u64::from(vertex) + 1);
    match has {
        [true, true] => writeln!(out, "f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}"),
        [true, false] => writeln!(out, "f {a}/{a} {b}/{b} {c}/{c}"),
        [false, true] => writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}"),
        [false, false] => writeln!(out, "f {a} {b} {c}"),
    }
}
