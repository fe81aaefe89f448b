//! Where a mesh is while it grows, and what is made of it in the end. [`InMemory`] keeps it in memory; [`super::files`] does not.

use cosurf_scene::Mesh;

use super::budget::MeshBytes;
use super::clean;
use super::error::MeshError;
use super::event::FuseEvent;
use super::extract::{Extraction, Layout};

/// Keeps a mesh while it grows, and makes something of it.
pub(super) trait Keeper {
    /// What is made of the mesh.
    type Made;
    /// Memory that the mesh takes for each block.
    const BYTES: MeshBytes;

    /// Bytes of memory that the mesh takes with the blocks of `layout`, and the layout.
    fn made_bytes(layout: &Layout) -> u64;

    /// Bytes of memory that [`Self::finish`] takes for a mesh that ends with the blocks of `layout`.
    fn end_bytes(layout: &Layout) -> u64;

    /// Forgets everything, because the fusion starts over.
    fn forget(&mut self) -> Result<(), MeshError>;

    /// Called after each part: may move what the mesh has so far out of the memory.
    fn keep(&mut self, extraction: &mut Extraction) -> Result<(), MeshError>;

    /// Removes specks, computes normals, and makes the result. Takes at most `memory_bytes`, which is not less than
    /// [`Self::end_bytes`].
    fn finish(
        &mut self,
        extraction: Extraction,
        memory_bytes: u64,
        on_event: &mut impl FnMut(FuseEvent) -> Result<(), MeshError>,
    ) -> Result<Self::Made, MeshError>;
}

/// Keeps all of the mesh in memory.
pub(super) struct InMemory;

impl Keeper for InMemory {
    type Made = Mesh;
    const BYTES: MeshBytes = MeshBytes::IN_MEMORY;

    fn made_bytes(layout: &Layout) -> u64 {
        layout.bytes()
    }

    fn end_bytes(_: &Layout) -> u64 {
        0 // less than while the last blocks were there
    }

    fn forget(&mut self) -> Result<(), MeshError> {
        Ok(())
    }

    fn keep(&mut self, _: &mut Extraction) -> Result<(), MeshError> {
        Ok(())
    }

    fn finish(
        &mut self,
        mut extraction: Extraction,
        _: u64,
        _: &mut impl FnMut(FuseEvent) -> Result<(), MeshError>,
    ) -> Result<Mesh, MeshError> {
        let (mut mesh, _) = extraction.move_out();
        clean::remove_specks(&mut mesh);
        if mesh.triangles.is_empty() {
            return Err(MeshError::NoAgreement);
        }
        mesh.normals = clean::normals(&mesh);
        Ok(mesh)
    }
}
