//! Which vertices of the mesh float: more views look through them, at a surface behind, than show them.
//!
//! What it knows nothing about: files, pixels of maps.

use cosurf_scene::{LocalFrame, Mesh};
use rayon::prelude::*;

use super::depths::DepthMap;
use super::parts;
use super::views::{Picture, Views};

/// The views of the vertices of a mesh, counted one map after the other.
pub(super) struct Floaters<'a> {
    mesh: &'a Mesh,
    /// The frame of the mesh.
    frame: &'a LocalFrame,
    /// Edge length of a voxel, metres.
    voxel_m: f64,
    views: Vec<Views>,
}

impl<'a> Floaters<'a> {
    /// No view yet. The mesh is in `frame`, and has voxels of `voxel_m`.
    pub(super) fn new(mesh: &'a Mesh, frame: &'a LocalFrame, voxel_m: f64) -> Self {
        Self { mesh, frame, voxel_m, views: vec![Views::default(); mesh.positions.len()] }
    }

    /// Bytes of the mesh, and of the counts and flags of its vertices.
    pub(super) fn held_bytes(&self, is_seen: &[bool]) -> u64 {
        parts::bytes(self.mesh) + (size_of_val(&self.views[..]) + size_of_val(is_seen)) as u64
    }

    /// Counts what a camera shows of the vertices that are seen.
    pub(super) fn add(&mut self, map: &DepthMap, is_seen: &[bool]) {
        let (picture, frame) = (Picture::new(map, self.voxel_m), self.frame);
        let vertices = self.views.par_iter_mut().zip(&self.mesh.positions).zip(is_seen);
        vertices.with_min_len(4096).filter(|(_, is_seen)| **is_seen).for_each(|((views, at), _)| {
            picture.add_point(views, frame.world_from_local(at.map(f64::from).into()));
        });
    }

    /// Sets `is_seen` of the vertices that float to false. At the edge of a roof, a view often looks past a vertex; so it
    /// must be more than half of the views.
    pub(super) fn leave_out(self, is_seen: &mut [bool]) {
        for (is_seen, views) in is_seen.iter_mut().zip(&self.views) {
            *is_seen &= views.through <= views.count;
        }
    }
}
