//! A mission's mesh: the global model's surface, fused over all cameras, written beside the model and ready to be
//! rendered.

use std::path::Path;

use cosurf_scene::{Camera, Caster, Mesh, SceneError, Splats};

use crate::mesh::{FuseEvent, FuseSettings, MeshError, mesh_model};
use crate::report::MeshSummary;

/// Memory limit of the fusion; if it is short, voxels become larger.
const MEMORY_BYTES: u64 = 2 << 30;

/// The mesh of a mission.
pub(crate) enum Relief {
    /// The mesh was made.
    Made { summary: MeshSummary, caster: Caster },
    /// No mesh could be made; the mission goes on without one.
    Missing(MeshError),
}

/// Makes the mesh and writes it to `file`. The long side of the renderings is at most `max_size_px`; `threads` (at
/// least 1) render.
pub(crate) fn relief(
    splats: Splats,
    cameras: &[Camera],
    max_size_px: Option<u32>,
    threads: usize,
    file: &Path,
    on_event: impl FnMut(FuseEvent),
) -> Result<Relief, SceneError> {
    let settings = FuseSettings { voxel_m: None, memory_bytes: MEMORY_BYTES };
    let fused = match mesh_model(splats, cameras, max_size_px, &settings, threads, on_event) {
        Ok(fused) => fused,
        Err(error) => return Ok(Relief::Missing(error)),
    };
    fused.mesh.write(file)?;
    let Mesh { triangles, .. } = &fused.mesh;
    let summary = MeshSummary { triangles: triangles.len(), voxel_m: fused.voxel_m };
    Ok(Relief::Made { summary, caster: Caster::new(&fused.mesh) })
}
