//! The mesh of a mission: the surface of the global model, fused from renderings of all cameras. It is written to a
//! file beside the model, and prepared for ray casting.

use std::path::Path;

use cosurf_scene::{Camera, Caster, LocalFrame, SceneError, Splats};

use crate::mesh::{FuseEvent, FuseSettings, Fused, MeshError, mesh_model};
use crate::report::MeshSummary;

/// Memory limit of making the mesh, bytes. If it is too small, pictures shrink and voxels become larger.
const MEMORY_BYTES: u64 = 2 << 30;

/// The mesh of a mission.
pub(crate) enum Relief {
    /// The mesh was made. The caster is in the frame.
    Made { summary: MeshSummary, caster: Caster },
    /// No mesh could be made; the mission goes on without one.
    Missing(MeshError),
}

/// Makes the mesh of splats and cameras that are in `frame`, and writes it to `file`, in the world. The long side of the
/// renderings is at most `max_size_px`. Rendering uses `threads` (at least 1) threads.
pub(crate) fn relief(
    splats: Splats,
    cameras: &[Camera],
    frame: &LocalFrame,
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
    let caster = Caster::new(&fused.mesh);
    let Fused { mesh, voxel_m, .. } = fused.out_of_frame(frame);
    mesh.write(file)?;
    Ok(Relief::Made { summary: MeshSummary { triangles: mesh.triangles.len(), voxel_m }, caster })
}
