//! Memory that a survey takes beside its splats.
#![allow(clippy::unwrap_used)]

use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_scene::Mesh;

use super::{FusedMesh, SLOPE, SurveyOrder, model, order};
use crate::mesh::MeshError;
use crate::survey::{SurveyError, survey};

/// Vertices along a side of the mesh.
const SIDE: u32 = 400;

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
    let Err(SurveyError::Mesh(MeshError::TooLittleMemory { needed_bytes, .. })) = with(1) else {
        panic!("a byte is not enough");
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
