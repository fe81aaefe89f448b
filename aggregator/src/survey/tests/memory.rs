//! Memory that a survey takes beside rendering its cameras.
#![allow(clippy::unwrap_used)]

use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_scene::Mesh;

use super::{
    EVERYWHERE, FusedMesh, MEMORY_BYTES, SLOPE, SurveyOrder, heights, model, order, tiles_of, whole,
};
use crate::mesh::MeshError;
use crate::survey::colors::Painter;
use crate::survey::lattice::TILE_PX;
use crate::survey::scene::Scene;
use crate::survey::splats::{Sieve, splats_from_above};
use crate::survey::tiles::Tiles;
use crate::survey::{LEAST_BYTES, SurveyError, survey, writing_bytes};

/// Vertices along a side of the mesh.
const SIDE: u32 = 800;

/// A slope of 8 m × 8 m with more triangles than a fusion makes of the model.
fn fine_mesh() -> Mesh {
    let at = |i: u32| [i % SIDE, i / SIDE].map(|of| 8.0 * of as f32 / SIDE as f32 - 4.0);
    let cells = (0..SIDE * (SIDE - 1)).filter(|i| i % SIDE + 1 < SIDE);
    Mesh {
        positions: (0..SIDE * SIDE).map(|i| [at(i)[0], at(i)[1], SLOPE as f32 * at(i)[0]]).collect(),
        rgb: vec![[120; 3]; (SIDE * SIDE) as usize],
        triangles: cells.flat_map(|i| [[i, i + 1, i + SIDE + 1], [i, i + SIDE + 1, i + SIDE]]).collect(),
        ..Mesh::default()
    }
}

/// The limit that a survey with this mesh asks for if it has none, bytes.
fn needed_bytes(mesh: &Mesh) -> u64 {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let file = folder.path().join("mesh.ply");
    mesh.write(&file).unwrap();
    let with = |memory_bytes: u64| {
        let mesh = Some(FusedMesh { file: file.clone(), voxel_m: 0.1 });
        survey(&SurveyOrder { mesh, memory_bytes, gsd_m: Some(0.5), ..order(folder.path()) }, |_| ())
    };
    let Err(SurveyError::Mesh(MeshError::TooLittleMemory { needed_bytes, .. })) = with(LEAST_BYTES) else {
        panic!("what writing maps needs is not enough");
    };
    assert!(with(needed_bytes).is_ok(), "{needed_bytes} bytes must do");
    assert!(with(needed_bytes - 1).is_err(), "fewer than {needed_bytes} bytes must not do");
    needed_bytes
}

/// Goal: the process keeps its limit while the model is rendered beside the mesh. Method: what is asked for grows by what a
/// larger mesh takes. When the mesh did not count, a survey of 2 million splats took 10 % more than its limit of 1 GiB.
#[test]
fn the_mesh_counts_while_the_model_is_rendered() {
    let fine = fine_mesh();
    let more = fine.triangles.len() / 2;
    let half = Mesh { triangles: fine.triangles[more..].to_vec(), ..fine.clone() };
    let [fine_bytes, half_bytes] = [needed_bytes(&fine), needed_bytes(&half)];
    assert_eq!(fine_bytes - half_bytes, 12 * more as u64);
    // A vertex has a position, a colour, three counts of views, and a flag.
    let vertices = u64::from(SIDE * SIDE);
    assert!(half_bytes > (12 + 3 + 12 + 1) * vertices + PROCESS_BYTES, "{half_bytes}");
}

/// Goal: a limit below what writing maps takes is refused before anything is made, with a limit that does. Without that, a survey
/// of 110,000 splats took 46.4 MiB of 46 MiB.
#[test]
fn limits_below_what_writing_maps_takes_are_refused_at_once() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let with = |memory_bytes: u64| survey(&SurveyOrder { memory_bytes, ..order(folder.path()) }, |_| ());
    let Err(SurveyError::TooLittleMemory { needed_bytes, .. }) = with(LEAST_BYTES - 1) else {
        panic!("a byte less is not enough");
    };
    assert!(!folder.path().join("out").exists());
    assert_eq!(needed_bytes, LEAST_BYTES, "rendering this model needs less");
    assert!(with(needed_bytes).is_ok());
}

/// Goal: a map that is too large to be written within the limit is refused with a limit that would do. Without that, a survey of
/// 550,000 splats took 52.5 MiB of 49 MiB.
#[test]
fn maps_that_are_too_large_for_the_limit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let with = |gsd_m: f64| {
        let order = SurveyOrder { memory_bytes: LEAST_BYTES, gsd_m: Some(gsd_m), ..order(folder.path()) };
        survey(&order, |_| ())
    };
    let Err(SurveyError::LittleForMap { size_px, needed_bytes, .. }) = with(0.004) else {
        panic!("a map of many tiles takes more");
    };
    assert!(size_px[0] > 4 * TILE_PX && needed_bytes > LEAST_BYTES, "{size_px:?}: {needed_bytes}");
    assert!(!folder.path().join("out/dsm.tif").exists());
    assert!(with(0.1).is_ok());
    assert_eq!([[1, 1], [1024, 1024]].map(writing_bytes), [LEAST_BYTES; 2]);
    assert_eq!(writing_bytes([5120, 5120]), writing_bytes([1 << 17, 1 << 17]), "a large map takes no more");
}

/// Goal: neither the search for splats that float nor the colours need the whole model in the memory. Method: with as little
/// memory as a refusal asks for, the same splats are left out, and the map has the same colours.
#[test]
fn colours_need_not_have_all_splats_in_the_memory() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    let (lattice, heights) = heights(&scene, folder.path(), 512);
    let paint = |memory_bytes: u64| {
        let mut tiles = tiles_of(&heights, folder.path(), lattice.size_px(), 512);
        let sieve = Sieve::new(&scene, &lattice, &mut tiles, EVERYWHERE, 0.1);
        let kept = splats_from_above(&scene, sieve, folder.path(), memory_bytes).unwrap();
        let mut colors = Tiles::new(folder.path(), lattice.size_px(), 512).unwrap();
        let painter = Painter { splats: kept.file(), frame: scene.frame, memory_bytes, threads: 2 };
        painter.paint(&lattice, &mut tiles, &mut colors, |_, _| ())?;
        Ok((std::fs::read(kept.file()).unwrap(), whole(&mut colors, [0; 4])))
    };
    let Err(SurveyError::Mesh(MeshError::TooLittleMemory { needed_bytes, .. })) = paint(1) else {
        panic!("a byte is not enough");
    };
    let (few_splats, few) = paint(needed_bytes).unwrap();
    let (splats, colors) = paint(MEMORY_BYTES).unwrap();
    assert!(few_splats == splats, "the splats that float are the same");
    let differs = |(a, b): (&[u8; 4], &[u8; 4])| a[3] == 255 && (0..4).any(|k| a[k].abs_diff(b[k]) > 2);
    let count = few.iter().zip(&colors).filter(|(a, b)| differs((a, b))).count();
    assert!(count * 1000 < colors.len(), "{count} of {} pixels differ", colors.len());
    let left = std::fs::read_dir(folder.path()).unwrap().flatten();
    assert!(left.into_iter().all(|entry| !entry.file_name().to_string_lossy().starts_with('.')));
}
