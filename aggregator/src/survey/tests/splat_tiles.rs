//! Tiles of splats.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use cosurf_engine::budget::PROCESS_BYTES;
use serde_json::Value;

use super::{SPLATS, georeference, model};
use crate::survey::SurveyError;
use crate::survey::place::Place;
use crate::survey::scene::Scene;
use crate::survey::splat_tiles::{SplatTiles, write_splat_tiles};

/// Enough for less than the whole model at a time.
const FEW_BYTES: u64 = PROCESS_BYTES + (10 << 20);

/// The document of a tile.
fn document(tile: &Path) -> Value {
    let file = fs::read(tile).unwrap();
    let length = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&file[20..20 + length]).unwrap()
}

fn splats(folder: &Path, tile: &Value) -> usize {
    let name = tile["content"]["uri"].as_str().unwrap();
    document(&folder.join(name))["accessors"][0]["count"].as_u64().unwrap() as usize
}

/// Lowest and highest corner of a tile's box.
fn corners(tile: &Value) -> [[f64; 3]; 2] {
    let of = |i: usize| tile["boundingVolume"]["box"][i].as_f64().unwrap();
    [-1.0, 1.0].map(|sign| [0, 1, 2].map(|axis| of(axis) + sign * of(3 + 4 * axis)))
}

#[test]
fn leaves_have_all_splats_that_do_not_float_and_the_root_a_quarter() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    let place = Place::new(&georeference(), None).unwrap();
    let floats: Vec<bool> = (0..=SPLATS).map(|splat| splat == SPLATS).collect();
    let write = |memory_bytes| write_splat_tiles(folder.path(), &scene, &floats, &place, memory_bytes);
    assert_eq!(write(1 << 30).unwrap(), SplatTiles { splats: SPLATS, left_out: 1, levels: 1 });
    assert_eq!(write(FEW_BYTES).unwrap(), SplatTiles { splats: SPLATS, left_out: 1, levels: 2 });
    let tiles = folder.path().join("splats");
    let json: Value = serde_json::from_slice(&fs::read(tiles.join("tileset.json")).unwrap()).unwrap();
    let required = &json["extensions"]["3DTILES_content_gltf"]["extensionsRequired"];
    assert_eq!(required, &document(&tiles.join("0-0.glb"))["extensionsRequired"]);
    let (root, children) = (&json["root"], json["root"]["children"].as_array().unwrap());
    assert_eq!(children.iter().map(|child| splats(&tiles, child)).sum::<usize>(), SPLATS);
    let quarter = SPLATS / 4;
    assert!((quarter..quarter + 20).contains(&splats(&tiles, root)), "each cell has one more at most");
    assert!(root["geometricError"].as_f64().unwrap() > 0.0);
    let [low, high] = corners(root);
    for child in children {
        assert_eq!(child["geometricError"], 0.0);
        let inner = corners(child);
        assert!((0..3).all(|i| inner[0][i] > low[i] - 1e-9 && inner[1][i] < high[i] + 1e-9), "{inner:?}");
    }
    assert_eq!(fs::read_dir(&tiles).unwrap().count(), children.len() + 2, "tiles of before are gone");
    let refused = write(PROCESS_BYTES).unwrap_err();
    assert!(matches!(refused, SurveyError::TooLittleMemory { .. }), "{refused}");
}
