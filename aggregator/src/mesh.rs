//! Makes a mesh from rendered depth: fuses truncated signed distances in a sparse volume of small blocks
//! (Curless and Levoy 1996; blocks as in Nießner et al. 2013), then extracts triangles by marching cubes.
//!
//! A first pass over smaller pictures determines the size of voxels and finds the blocks that the surface passes
//! through. Then all blocks are allocated at once, and the views are fused into them one after the other. Each view is
//! fused into all blocks in parallel, so the mesh has the same bytes for any number of threads. If the memory is too
//! small for the wanted voxels, the voxels become larger. [`mesh_model`] refuses a memory limit that is too small for
//! any mesh.
//!
//! What it knows nothing about: how views are rendered. [`fuse()`] takes a function that returns a
//! [`cosurf_engine::Rendering`] for a camera; only [`mesh_model`] knows a renderer.
//!
//! Where to start reading: [`fuse()`], then `volume` and `extract`. [`mesh_model`] renders a splat model and fuses the
//! renderings.

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
pub use model::{check_memory, mesh_model};
