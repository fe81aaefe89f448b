//! From rendered depth to a mesh: truncated signed distances are fused in a sparse volume of small
//! blocks (Curless and Levoy 1996; blocks as in Nießner et al. 2013), of which marching cubes makes
//! triangles.
//!
//! First a look at the surface with small pictures says how large voxels should be and which blocks
//! the surface passes through; then, all sizes known, the volume is allocated once and every view is
//! fused into it, one after the other, its blocks in parallel. So the mesh has the same bytes for any
//! number of threads, and memory is a promise: where it does not suffice, voxels become larger.
//!
//! What it refuses to know: who renders. [`fuse()`] takes a function from cameras to [`cosurf_engine::Rendering`]s.
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
