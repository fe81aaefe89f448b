//! Splats as binary glTF 2.0, with the extensions `KHR_gaussian_splatting` (ratified by Khronos in 2026) and
//! `KHR_gaussian_splatting_compression_spz_2` (a draft of Khronos, pull request 2531; what CesiumJS reads): the buffer is an SPZ
//! file of version 2.
//!
//! glTF's axes are right, up, back, as those of SPZ. The world's z becomes up.
//!
//! What it knows nothing about: tiles.

use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;
use std::io::Write;
use std::path::Path;

use glam::DQuat;
use serde_json::{Value, json};

use crate::spz::{self, Version};
use crate::turn::turn;
use crate::{SceneError, Splats, glb};

/// The extensions that every file needs.
pub const EXTENSIONS: [&str; 2] = [BASE, COMPRESSION];

const BASE: &str = "KHR_gaussian_splatting";
const COMPRESSION: &str = "KHR_gaussian_splatting_compression_spz_2";
/// glTF's number for 8-bit unsigned integers as the components of an accessor.
const UNSIGNED_BYTE: u32 = 5121;
/// glTF's number for 32-bit floats as the components of an accessor.
const FLOAT: u32 = 5126;
/// glTF's number for primitives that are points.
const POINTS: u32 = 0;

/// Writes splats of a z-up world, at least one, atomically. Errors: a coordinate beyond ±8,388,607.
pub fn write(path: &Path, mut splats: Splats) -> Result<(), SceneError> {
    // The writer of SPZ turns y and z around; so what it gets has y down and z forward.
    turn(&mut splats, DQuat::from_rotation_x(FRAC_PI_2));
    let bytes = spz::to_bytes_of(&splats, Version::V2).ok_or_else(|| {
        SceneError::malformed(path, "glTF with SPZ cannot hold coordinates beyond 8,388,607")
    })?;
    let padded_bytes = bytes.len().next_multiple_of(4);
    glb::write(path, &describe(&splats, bytes.len()), padded_bytes as u64, "write .ply", |out| {
        out.write_all(&bytes)?;
        out.write_all(&[0; 3][..padded_bytes - bytes.len()])
    })
}

/// The document. Its accessors have no data: readers take what the SPZ file holds.
fn describe(splats: &Splats, bytes: usize) -> Value {
    let count = splats.len();
    let (min, max) = bounds(splats);
    let floats = |kind: &str| json!({"componentType": FLOAT, "type": kind, "count": count});
    let mut position = floats("VEC3");
    (position["min"], position["max"]) = (json!(min), json!(max));
    let color = json!({"componentType": UNSIGNED_BYTE, "type": "VEC4", "count": count, "normalized": true});
    let mut accessors = vec![position, color, floats("VEC3"), floats("VEC4")];
    let mut attributes = BTreeMap::from([
        ("POSITION".to_owned(), 0),
        ("COLOR_0".to_owned(), 1),
        (format!("{BASE}:SCALE"), 2),
        (format!("{BASE}:ROTATION"), 3),
    ]);
    for degree in 1..=splats.sh_degree {
        for coefficient in 0..=2 * degree {
            attributes.insert(format!("{BASE}:SH_DEGREE_{degree}_COEF_{coefficient}"), accessors.len());
            accessors.push(floats("VEC3"));
        }
    }
    let extension = json!({BASE: {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "extensions": {COMPRESSION: {"bufferView": 0}},
    }});
    let primitive = json!({"attributes": attributes, "mode": POINTS, "extensions": extension});
    json!({
        "asset": {"version": "2.0", "generator": "cosurf"},
        "extensionsUsed": EXTENSIONS,
        "extensionsRequired": EXTENSIONS,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": bytes}],
        "bufferViews": [{"buffer": 0, "byteLength": bytes}],
        "accessors": accessors,
    })
}

/// Minimum and maximum coordinates in the file, which glTF requires.
fn bounds(splats: &Splats) -> ([f32; 3], [f32; 3]) {
    let in_file = |[x, y, z]: &[f32; 3]| [*x, -y, -z];
    splats.means.iter().map(in_file).fold(([f32::MAX; 3], [f32::MIN; 3]), |(min, max), at| {
        let of = |pick: fn(f32, f32) -> f32, so_far: [f32; 3]| [0, 1, 2].map(|i| pick(so_far[i], at[i]));
        (of(f32::min, min), of(f32::max, max))
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_file_holds_an_spz_whose_up_is_the_worlds_z() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tile.glb");
        let mut splats = Splats::with_capacity(2, 1);
        let mut sh = [0.0; 12];
        sh[6] = 0.5; // red grows with the z of the direction
        splats.push([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0], [-3.0, -4.0, -5.0], 2.0, &sh);
        splats.push([-1.0, 20.0, -3.0], [1.0, 0.0, 0.0, 0.0], [-3.0; 3], 2.0, &sh);
        write(&path, splats).unwrap();
        let file = std::fs::read(&path).unwrap();
        let number = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], number(8)), (&b"glTF"[..], file.len()));
        let end = 20 + number(12);
        let json: Value = serde_json::from_slice(&file[20..end]).unwrap();
        assert_eq!(json["extensionsRequired"], json!(EXTENSIONS));
        let position = &json["accessors"][0];
        assert_eq!(
            (&position["min"], &position["max"]),
            (&json!([-1.0, -3.0, -20.0]), &json!([1.0, 3.0, -2.0]))
        );
        let primitive = &json["meshes"][0]["primitives"][0];
        assert_eq!(primitive["attributes"].as_object().unwrap().len(), 4 + 3);
        assert_eq!(primitive["attributes"]["KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"], 6);
        let bytes = json["buffers"][0]["byteLength"].as_u64().unwrap() as usize;
        let spz_file = folder.path().join("tile.spz");
        std::fs::write(&spz_file, &file[end + 8..end + 8 + bytes]).unwrap();
        assert_eq!(file.len(), end + 8 + bytes.next_multiple_of(4));
        let read = spz::read(&spz_file).unwrap();
        // The reader turns y and z around again.
        assert_eq!(read.means, [[1.0, -3.0, 2.0], [-1.0, 3.0, 20.0]]);
        // In these axes, the world's z is -y: the harmonic of degree 1 that is minus y.
        let red = |k: usize| read.sh_of(0)[3 * k];
        assert!(
            (red(1) - 0.5).abs() < 0.05 && red(2).abs() < 0.05 && red(3).abs() < 0.05,
            "{:?}",
            read.sh_of(0)
        );
    }
}
