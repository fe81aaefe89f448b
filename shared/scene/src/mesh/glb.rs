//! Meshes as binary glTF 2.0.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::Path;

use glam::DVec3;
use serde_json::{Map, Value, json};

use super::data::Mesh;
use super::texture::Texture;
use crate::{SceneError, glb};

/// glTF's number for 16-bit unsigned integers as the components of an accessor.
const UNSIGNED_SHORT: u32 = 5123;
/// glTF's number for 32-bit unsigned integers as the components of an accessor.
const UNSIGNED_INT: u32 = 5125;
/// glTF's number for 32-bit floats as the components of an accessor.
const FLOAT: u32 = 5126;
/// glTF's number for a buffer view of vertex attributes.
const ARRAY_BUFFER: u32 = 34962;
/// glTF's number for a buffer view of vertex indices.
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
/// glTF's number for a texture filter that blends the four nearest pixels.
const LINEAR: u32 = 9729;
/// The same for a filter that also blends smaller copies of the picture.
const LINEAR_MIPMAP_LINEAR: u32 = 9987;
/// glTF's number for a texture that does not repeat.
const CLAMP_TO_EDGE: u32 = 33071;
/// The extension for materials that are shown without light.
const UNLIT: &str = "KHR_materials_unlit";
/// The quaternion (xyzw) of a rotation by -90° about x, which maps z to y.
const Y_FROM_Z: [f32; 4] = [-std::f32::consts::FRAC_1_SQRT_2, 0.0, 0.0, std::f32::consts::FRAC_1_SQRT_2];

pub(super) fn write(
    path: &Path,
    mesh: &Mesh,
    texture: Option<&Texture>,
    extras: &Map<String, Value>,
) -> Result<(), SceneError> {
    if mesh.triangles.is_empty() {
        return Err(SceneError::malformed(path, "a glb file needs triangles; write the points as .ply"));
    }
    let surface = texture.map_or(Ok(Surface::Colors), Surface::of)?;
    let (document, numbers_bytes) = describe(mesh, &surface, extras);
    glb::write(path, &document, numbers_bytes, "write the mesh as .ply", |out| {
        write_numbers(out, mesh, &surface)
    })
}

/// What colours the mesh.
enum Surface<'a> {
    /// The colours of its vertices, if it has any.
    Colors,
    /// A texture, and the length of its picture, bytes.
    Texture(&'a Texture, u64),
}

impl<'a> Surface<'a> {
    fn of(texture: &'a Texture) -> Result<Self, SceneError> {
        let picture = &texture.picture;
        let about = fs::metadata(picture).map_err(|cause| SceneError::io(picture, cause))?;
        Ok(Self::Texture(texture, about.len()))
    }
}

/// Buffer views and accessors of the arrays in the binary chunk, in file order.
#[derive(Default)]
struct Arrays {
    views: Vec<Value>,
    accessors: Vec<Value>,
    bytes: u64,
}

impl Arrays {
    /// Appends an array of `count` items of `item_bytes`; returns the index of its accessor.
    fn push(&mut self, count: usize, item_bytes: u64, target: u32, mut accessor: Value) -> usize {
        let length = count as u64 * item_bytes;
        self.views
            .push(json!({"buffer": 0, "byteOffset": self.bytes, "byteLength": length, "target": target}));
        accessor["bufferView"] = self.accessors.len().into();
        accessor["count"] = count.into();
        self.accessors.push(accessor);
        self.bytes += length;
        self.accessors.len() - 1
    }

    /// Appends a file of so many bytes, and what fills it up to a multiple of four; returns the index of its view.
    fn push_file(&mut self, file_bytes: u64) -> usize {
        self.views.push(json!({"buffer": 0, "byteOffset": self.bytes, "byteLength": file_bytes}));
        self.bytes += file_bytes.next_multiple_of(4);
        self.views.len() - 1
    }
}

/// Returns the document, and the length in bytes of the binary chunk that the JSON describes.
fn describe(mesh: &Mesh, surface: &Surface<'_>, extras: &Map<String, Value>) -> (Value, u64) {
    let mut arrays = Arrays::default();
    let (min, max) = bounds(mesh);
    let vertices = mesh.positions.len();
    let position = json!({"componentType": FLOAT, "type": "VEC3", "min": min, "max": max});
    let mut attributes = json!({"POSITION": arrays.push(vertices, 12, ARRAY_BUFFER, position)});
    if !mesh.normals.is_empty() {
        let normal = json!({"componentType": FLOAT, "type": "VEC3"});
        attributes["NORMAL"] = arrays.push(vertices, 12, ARRAY_BUFFER, normal).into();
    }
    match surface {
        Surface::Colors if !mesh.rgb.is_empty() => {
            let color = json!({"componentType": UNSIGNED_SHORT, "type": "VEC4", "normalized": true});
            attributes["COLOR_0"] = arrays.push(vertices, 8, ARRAY_BUFFER, color).into();
        }
        Surface::Colors => {}
        // Without colours: viewers would multiply both.
        Surface::Texture(..) => {
            let uv = json!({"componentType": FLOAT, "type": "VEC2"});
            attributes["TEXCOORD_0"] = arrays.push(vertices, 8, ARRAY_BUFFER, uv).into();
        }
    }
    let index = json!({"componentType": UNSIGNED_INT, "type": "SCALAR"});
    let indices = arrays.push(3 * mesh.triangles.len(), 4, ELEMENT_ARRAY_BUFFER, index);
    let mut node = json!({"mesh": 0, "rotation": Y_FROM_Z});
    if mesh.origin != DVec3::ZERO {
        // glTF moves a node after it has turned it.
        node["translation"] = json!([mesh.origin.x, mesh.origin.z, -mesh.origin.y]);
    }
    let mut material = json!({
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
        "doubleSided": true, // the surface is open, so cameras may also see its back
    });
    let mut textures = json!({});
    if let Surface::Texture(_, picture_bytes) = surface {
        material["pbrMetallicRoughness"]["baseColorTexture"] = json!({"index": 0});
        let filter = json!({
            "magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE,
        });
        textures = json!({
            "images": [{"bufferView": arrays.push_file(*picture_bytes), "mimeType": "image/jpeg"}],
            "samplers": [filter],
            "textures": [{"source": 0, "sampler": 0}],
        });
    }
    let mut asset = json!({"version": "2.0", "generator": "cosurf"});
    if !extras.is_empty() {
        asset["extras"] = Value::Object(extras.clone());
    }
    if mesh.normals.is_empty() {
        material["extensions"] = json!({UNLIT: {}});
    }
    let mut document = json!({
        "asset": asset,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [material],
        "buffers": [{"byteLength": arrays.bytes}],
        "bufferViews": arrays.views,
        "accessors": arrays.accessors,
    });
    if mesh.normals.is_empty() {
        document["extensionsUsed"] = json!([UNLIT]);
    }
    if let (Value::Object(document), Value::Object(textures)) = (&mut document, textures) {
        document.extend(textures);
    }
    (document, arrays.bytes)
}

/// Minimum and maximum coordinates of the positions, which glTF requires.
fn bounds(mesh: &Mesh) -> ([f32; 3], [f32; 3]) {
    let mut bounds = ([f32::MAX; 3], [f32::MIN; 3]);
    for position in &mesh.positions {
        for axis in 0..3 {
            bounds.0[axis] = bounds.0[axis].min(position[axis]);
            bounds.1[axis] = bounds.1[axis].max(position[axis]);
        }
    }
    bounds
}

/// Writes the arrays in the order in which [`describe`] lists them.
fn write_numbers(out: &mut impl Write, mesh: &Mesh, surface: &Surface<'_>) -> io::Result<()> {
    for position in &mesh.positions {
        out.write_all(position.map(f32::to_le_bytes).as_flattened())?;
    }
    for normal in &mesh.normals {
        // glTF requires unit normals, so an unknown normal is written as up, the world's +z.
        let normal = if *normal == [0.0; 3] { [0.0, 0.0, 1.0] } else { *normal };
        out.write_all(normal.map(f32::to_le_bytes).as_flattened())?;
    }
    match surface {
        Surface::Colors => {
            for rgb in &mesh.rgb {
                let [r, g, b] = rgb.map(linear_from_srgb);
                out.write_all([r, g, b, u16::MAX].map(u16::to_le_bytes).as_flattened())?;
            }
        }
        Surface::Texture(texture, _) => {
            for uv in &texture.uv {
                out.write_all(uv.map(f32::to_le_bytes).as_flattened())?;
            }
        }
    }
    for corners in &mesh.triangles {
        out.write_all(corners.map(u32::to_le_bytes).as_flattened())?;
    }
    match surface {
        Surface::Colors => Ok(()),
        Surface::Texture(texture, bytes) => copy_picture(out, &texture.picture, *bytes),
    }
}

/// Copies a file of so many bytes, and fills it up to a multiple of four.
fn copy_picture(out: &mut impl Write, picture: &Path, bytes: u64) -> io::Result<()> {
    if io::copy(&mut File::open(picture)?.take(bytes), out)? < bytes {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    out.write_all(&[0; 3][..(bytes.next_multiple_of(4) - bytes) as usize])
}

/// Converts 8-bit sRGB to linear light (IEC 61966-2-1), as glTF stores vertex colours. 16 bits keep
/// dark shades distinct.
fn linear_from_srgb(byte: u8) -> u16 {
    let v = f32::from(byte) / 255.0;
    let linear = if v <= 0.040_45 { v / 12.92 } else { libm::powf((v + 0.055) / 1.055, 2.4) };
    (linear * 65_535.0).round() as u16
}
