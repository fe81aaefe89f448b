//! The splats as 3D Tiles 1.1: `splats/tileset.json`, and tiles as glTF with SPZ, for viewers that load only what they show.
//!
//! The ground is divided into the leaves of a quadtree, which have all splats that do not float. A tile above has a quarter of
//! the splats of the tiles below, the most important ones, each enlarged so that together they cover as much
//! ([`levels`]). The model is read once for every few tiles, as many as fit into the memory.
//!
//! What it knows nothing about: how splats are stored; the mesh.
//!
//! Where to start reading: [`write_splat_tiles`].

mod levels;

use std::collections::BTreeMap;
use std::path::Path;

use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_scene::{Splats, atomic, splat_glb};
use glam::{DAffine3, DVec3};
use serde_json::json;

use super::error::SurveyError;
use super::place::Place;
use super::quadtree::Key;
use super::scene::Scene;
use super::tileset::{self, Bounds, Tile, tileset};
use levels::{Division, Levels, Source};

/// Folder of the tiles.
const FOLDER: &str = "splats";
/// Largest number of splats of a leaf: with harmonics of degree 3, about a megabyte.
const LEAF_MOST: usize = 50_000;
/// Smallest limit on the number of splats of a leaf, however little memory there is.
const LEAF_LEAST: usize = 2_000;
/// Bytes for what is read, and for the levels.
const READING_BYTES: u64 = 8 << 20;
/// Bytes for each splat of a tile while it is written: turned, packed and compressed.
const WRITING_BYTES: u64 = 200;
/// How wrong a tile is: the distance between its splats, times this. So a viewer that allows an error of 16 px, as
/// CesiumJS does, loads the tiles below once splats are more than 4 px apart.
const ERROR_SPACINGS: f64 = 4.0;
/// A tile is at least this many times as wrong as the tiles below it.
const COARSER: f64 = 1.5;

/// What was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SplatTiles {
    /// Number of splats of the finest tiles.
    pub(super) splats: usize,
    /// Number of splats that float or lie far outside of the mesh, and are in no tile.
    pub(super) left_out: usize,
    /// Number of levels of detail.
    pub(super) levels: usize,
}

/// Writes the splats of a scene, without those that float, to a folder in `out`. At least one must be left.
pub(super) fn write_splat_tiles(
    out: &Path,
    scene: &Scene,
    floats: &[bool],
    place: &Place,
    memory_bytes: u64,
) -> Result<SplatTiles, SurveyError> {
    let folder = out.join(FOLDER);
    tileset::make_folder(&folder)?;
    let bytes_per_splat = Splats::bytes_per_splat(scene.sh_degree()?) as u64;
    let held_bytes = PROCESS_BYTES + READING_BYTES + floats.len() as u64;
    let room_bytes = memory_bytes.saturating_sub(held_bytes);
    let leaf_most = room_bytes / (2 * (bytes_per_splat + WRITING_BYTES));
    let leaf_most = (leaf_most as usize).clamp(LEAF_LEAST, LEAF_MOST);
    let source = Source { scene, floats };
    let division = Division::of(&source, leaf_most)?;
    let levels = Levels::of(&source, &division)?;

    let mut tiles: BTreeMap<(u32, Key), Tile> = BTreeMap::new();
    for depth in (0..=division.depth()).rev() {
        let counts = levels.counts(depth);
        let mut rest: Vec<(Key, usize)> = counts.into_iter().rev().collect();
        while let Some(batch) = next_batch(&mut rest, room_bytes, bytes_per_splat) {
            let needed_bytes = held_bytes + batch_bytes(&batch, bytes_per_splat);
            if needed_bytes > memory_bytes && batch.len() == 1 {
                return Err(SurveyError::TooLittleMemory { needed_bytes, memory_bytes });
            }
            for (key, splats) in levels.splats(&source, depth, &batch)? {
                let tile = write_tile(&folder, depth, key, splats, &tiles)?;
                tiles.insert((depth, key), tile);
            }
        }
    }
    let origin = DAffine3::from_translation(scene.frame.origin());
    let mut json = tileset(&tiles, "", place.ecef_from_enu() * origin);
    // CesiumJS decides by this what tiles are.
    let extensions = splat_glb::EXTENSIONS;
    let needs = json!({"extensionsUsed": extensions, "extensionsRequired": extensions});
    json["extensionsUsed"] = json!(["3DTILES_content_gltf"]);
    json["extensions"] = json!({"3DTILES_content_gltf": needs});
    atomic::write_bytes(&folder.join("tileset.json"), json.to_string().as_bytes())?;
    let splats = levels.counts(division.depth()).values().sum();
    Ok(SplatTiles { splats, left_out: floats.len() - splats, levels: division.depth() as usize + 1 })
}

/// Takes as many tiles from the end as fit into the memory, at least one. `None` if there are no more.
fn next_batch(
    rest: &mut Vec<(Key, usize)>,
    room_bytes: u64,
    bytes_per_splat: u64,
) -> Option<BTreeMap<Key, usize>> {
    let mut batch = BTreeMap::from([rest.pop()?]);
    while let Some((key, count)) = rest.pop() {
        batch.insert(key, count);
        if batch_bytes(&batch, bytes_per_splat) > room_bytes {
            batch.remove(&key);
            rest.push((key, count));
            break;
        }
    }
    Some(batch)
}

/// Bytes of the splats of a batch, and for writing its largest tile.
fn batch_bytes(batch: &BTreeMap<Key, usize>, bytes_per_splat: u64) -> u64 {
    let largest = batch.values().max().copied().unwrap_or(0) as u64;
    batch.values().sum::<usize>() as u64 * bytes_per_splat + largest * WRITING_BYTES
}

/// Writes the splats of a tile. `tiles` has those below.
fn write_tile(
    folder: &Path,
    depth: u32,
    key: Key,
    splats: Splats,
    tiles: &BTreeMap<(u32, Key), Tile>,
) -> Result<Tile, SurveyError> {
    let bounds = Bounds::around(splats.means.iter().map(|mean| DVec3::from_array(mean.map(f64::from))));
    let spacing_m = (bounds.area_m2() / splats.len() as f64).sqrt();
    splat_glb::write(&folder.join(tileset::name(depth, key)), splats)?;
    let below = tiles.range((depth + 1, key << 2)..=(depth + 1, key << 2 | 3)).map(|(_, tile)| *tile);
    let own = |error_m: f64| Tile { bounds, error_m };
    Ok(match below.reduce(|a, b| a.joined(&b)) {
        Some(below) => own((ERROR_SPACINGS * spacing_m).max(COARSER * below.error_m)).joined(&below),
        None => own(0.0),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn batches_have_as_many_tiles_as_fit_and_at_least_one() {
        let mut rest = vec![(3, 10), (2, 1000), (1, 10), (0, 10)];
        let mut next =
            || next_batch(&mut rest, 30 * (100 + WRITING_BYTES), 100).map(|of| of.into_keys().collect());
        let found: Vec<Vec<Key>> = std::iter::from_fn(&mut next).collect();
        assert_eq!(found, [vec![0, 1], vec![2], vec![3]]);
    }
}
