//! The mesh of a global model: its surface, fused from renderings of all cameras. It is written to a file beside the
//! model, and prepared for ray casting.

use std::ops::ControlFlow;
use std::path::Path;

use cosurf_scene::files::with_space;
use cosurf_scene::{Camera, Caster, LocalFrame, Mesh, SceneError, atomic};

use crate::mesh::{FuseEvent, FuseSettings, Fused, MeshError, MeshSource, mesh_file};
use crate::report::MeshSummary;

/// The part of the memory that is left for the caster, which is made while the mesh is there: without it, a mission of 100 MiB
/// took 111.
const CASTER_SHARE: u64 = 6;

/// The mesh of a global model.
pub(crate) enum Relief {
    /// The mesh was made. The caster is in the frame.
    Made { summary: MeshSummary, caster: Caster },
    /// No mesh could be made.
    Missing(MeshError),
}

/// Makes the mesh of the model in the PLY file `model`, and of cameras that are in `frame`, and writes it to `file`, in the
/// world. Takes at most `memory_bytes`: if that is little, pictures shrink and voxels become larger. Rendering uses
/// `threads` (at least 1) threads. If `on_event` returns `Break`, the mesh is missing because of [`MeshError::Stopped`].
pub(crate) fn relief(
    model: &Path,
    cameras: &[Camera],
    frame: &LocalFrame,
    memory_bytes: u64,
    threads: usize,
    file: &Path,
    on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Relief, SceneError> {
    let settings = FuseSettings { voxel_m: None, memory_bytes: memory_bytes - memory_bytes / CASTER_SHARE };
    let source = MeshSource { model: model.to_owned(), frame, cameras, max_size_px: None };
    let fused = match mesh_file(&source, &settings, threads, on_event) {
        Ok(fused) => fused,
        Err(MeshError::Scene(error)) => return Err(error),
        Err(error) => return Ok(Relief::Missing(error)),
    };
    let caster = Caster::new(&fused.mesh);
    let Fused { mesh, voxel_m, .. } = fused.out_of_frame(frame);
    write(&mesh, file)?;
    Ok(Relief::Made { summary: MeshSummary { triangles: mesh.triangles.len(), voxel_m }, caster })
}

/// Writes a mesh. If the disk is too full for it, the error tells how much is free and needed.
fn write(mesh: &Mesh, file: &Path) -> Result<(), SceneError> {
    mesh.write(file).map_err(|error| with_space(error, atomic::folder_of(file), least_bytes(mesh)))
}

/// Least size of a mesh in a PLY file, without its header.
fn least_bytes(Mesh { positions, normals, rgb, triangles, .. }: &Mesh) -> u64 {
    let corners = triangles.len() * (1 + size_of::<[u32; 3]>());
    let vertices = size_of_val(&positions[..]) + size_of_val(&normals[..]) + size_of_val(&rgb[..]);
    (corners + vertices) as u64
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_least_size_of_a_mesh_is_near_that_of_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mesh.ply");
        let mesh = Mesh {
            positions: vec![[1.0; 3]; 300],
            rgb: vec![[9; 3]; 300],
            triangles: vec![[0, 1, 2]; 500],
            ..Mesh::default()
        };
        write(&mesh, &file).unwrap();
        let bytes = file.metadata().unwrap().len();
        assert!((bytes - 400..bytes).contains(&least_bytes(&mesh)), "{bytes}: {}", least_bytes(&mesh));
    }
}
