//! `tileset.json` of 3D Tiles 1.1 (OGC 22-025r4): which tile is where, and how wrong it is.
//!
//! What it knows nothing about: what the tiles show.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use cosurf_scene::{SceneError, files};
use glam::{DAffine3, DVec3};
use serde_json::{Value, json};

use super::quadtree::{Key, parent};

/// How many times as wrong as the root nothing at all is.
const NOTHING: f64 = 4.0;

/// A box along the axes of the world, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Bounds {
    low: DVec3,
    high: DVec3,
}

impl Bounds {
    /// The box around some positions.
    pub(super) fn around(positions: impl Iterator<Item = DVec3>) -> Self {
        let nothing = Self { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY };
        positions.fold(nothing, |bounds, at| Self { low: bounds.low.min(at), high: bounds.high.max(at) })
    }

    /// The box around both.
    fn joined(&self, other: &Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    /// Its area seen from above, square metres.
    pub(super) fn area_m2(&self) -> f64 {
        let across = self.high - self.low;
        across.x * across.y
    }

    /// The specification's twelve numbers: the middle, and half of each side.
    fn numbers(&self) -> [f64; 12] {
        let (middle, half) = (0.5 * (self.low + self.high), 0.5 * (self.high - self.low));
        [middle.x, middle.y, middle.z, half.x, 0.0, 0.0, 0.0, half.y, 0.0, 0.0, 0.0, half.z]
    }
}

/// A tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tile {
    pub(super) bounds: Bounds,
    /// How wrong it is compared with the finest tiles, metres.
    pub(super) error_m: f64,
}

impl Tile {
    /// A tile that covers both, as wrong as the worse one.
    pub(super) fn joined(&self, other: &Self) -> Self {
        Self { bounds: self.bounds.joined(&other.bounds), error_m: self.error_m.max(other.error_m) }
    }
}

/// Name of a tile's file.
pub(super) fn name(depth: u32, key: Key) -> String {
    format!("{depth}-{key}.glb")
}

/// Whether a file may be a tile, by its name.
fn is_name(name: &str) -> bool {
    let number = |text: &str| text.parse::<u32>().is_ok();
    let parts = name.strip_suffix(".glb").and_then(|stem| stem.split_once('-'));
    parts.is_some_and(|(depth, key)| number(depth) && number(key))
}

/// Makes a folder for tiles, and removes those of an earlier run from it.
pub(super) fn make_folder(folder: &Path) -> Result<(), SceneError> {
    let failed = |cause| SceneError::io(folder, cause);
    files::create_folder(folder)?;
    for entry in fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.file_name().and_then(|name| name.to_str()).is_some_and(is_name) {
            fs::remove_file(&path).map_err(|cause| SceneError::io(&path, cause))?;
        }
    }
    Ok(())
}

/// The content of the file. `tiles` has the root, `(0, 0)`, and with each tile the one above it. Names of files begin with
/// `prefix`. Tiles are in a frame of metres, `ecef_from_tiles`.
pub(super) fn tileset(tiles: &BTreeMap<(u32, Key), Tile>, prefix: &str, ecef_from_tiles: DAffine3) -> Value {
    let mut done: BTreeMap<(u32, Key), Value> = BTreeMap::new();
    let mut children: BTreeMap<(u32, Key), Vec<Value>> = BTreeMap::new();
    for ((depth, key), tile) in tiles.iter().rev() {
        let mut json = json!({
            "boundingVolume": {"box": tile.bounds.numbers()},
            "geometricError": tile.error_m,
            "refine": "REPLACE",
            "content": {"uri": format!("{prefix}{}", name(*depth, *key))},
        });
        if let Some(mut children) = children.remove(&(*depth, *key)) {
            children.reverse();
            json["children"] = children.into();
        }
        match depth.checked_sub(1) {
            Some(above) => children.entry((above, parent(*key))).or_default().push(json),
            None => _ = done.insert((*depth, *key), json),
        }
    }
    let mut root = done.remove(&(0, 0)).unwrap_or_default();
    root["transform"] = json!(glam::DMat4::from(ecef_from_tiles).to_cols_array());
    let error_m = tiles.get(&(0, 0)).map_or(0.0, |root| {
        let across_m = (root.bounds.high - root.bounds.low).max_element();
        (NOTHING * root.error_m).max(across_m)
    });
    json!({
        "asset": {"version": "1.1"},
        "geometricError": error_m,
        "root": root,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tiles_have_names_of_tiles() {
        assert!(is_name(&name(3, 63)));
        assert!(["mesh.glb", "3-x.glb", "3-1.glb.partial", "3.glb"].iter().all(|name| !is_name(name)));
    }

    #[test]
    fn boxes_have_middles_and_half_sides() {
        let bounds = Bounds::around([DVec3::new(1.0, 2.0, 3.0), DVec3::new(3.0, 6.0, 9.0)].into_iter());
        assert_eq!(bounds.numbers(), [2.0, 4.0, 6.0, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 3.0]);
    }
}
