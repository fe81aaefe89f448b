//! Makes a mesh from rendered depth: fuses truncated signed distances in a sparse volume of small blocks
//! (Curless and Levoy 1996; blocks as in Nießner et al. 2013), then extracts triangles by marching cubes.
//!
//! A first pass over small pictures determines the size of voxels and the blocks that the surface passes
//! through. Then the volume is allocated once, and the views are fused into it one after the other, each
//! into all blocks in parallel. So the mesh has the same bytes for any number of threads. The memory limit
//! is never exceeded: if it is too small, voxels become larger.
//!
//! What it refuses to know: the renderer. [`fuse()`] takes a function from cameras to [`cosurf_engine::Rendering`]s.
//!
//! Where to start reading: [`fuse()`], then `volume`, `extract`; [`mesh_model`] renders a model for it.

mod budget;
mod cases;
mod clean;
mod error;
mod event;
mod extract;
mod frame;
mod fuse;
mod model;
mod scout;
#[cfg(test)]
mod tests;
mod volume;

pub use error::MeshError;
pub use event::{FuseEvent, Stage};
pub use fuse::{FuseSettings, Fused, fuse};
pub use model::mesh_model;
