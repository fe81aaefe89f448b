//! The model in a folder: its cameras, its mesh, and the splats of its surface.
//!
//! What it knows nothing about: maps.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use cosurf_engine::budget::Viewing;
use cosurf_scene::{Camera, Dataset, LocalFrame, Mesh, SceneError, Splats, ply};
use glam::DVec3;
use rayon::prelude::*;

use super::colors::PICTURE_PX;
use super::error::SurveyError;
use super::heights::Surface;
use crate::mesh::{FuseEvent, FuseSettings, MeshError, check_memory, mesh_model};

/// A splat more than this many voxels above the mesh floats: where views agree, the surface is within a voxel or two.
const FLOATING_VOXELS: f64 = 5.0;
/// The mesh counts up to this many voxels beside a splat, so that splats at the edge of a roof do not float.
const BESIDE_VOXELS: f64 = 2.0;

/// A model that has not been read.
#[derive(Debug)]
pub(super) struct Scene {
    model: PathBuf,
    /// The cameras, in the world.
    pub(super) cameras: Vec<Camera>,
    /// The frame to compute in.
    pub(super) frame: LocalFrame,
}

/// The surface of a model.
#[derive(Debug)]
pub(super) struct Relief {
    /// In the frame of the scene.
    pub(super) mesh: Mesh,
    /// Edge length of a voxel, metres.
    pub(super) voxel_m: f64,
}

/// The splats that lie on the surface.
pub(super) struct Kept {
    /// In the frame of the scene.
    pub(super) splats: Splats,
    /// Number of those that float above the surface.
    pub(super) left_out: usize,
}

impl Scene {
    /// Reads cameras and header. An error if the memory is too small for the splats.
    pub(super) fn open(folder: &Path, memory_bytes: u64) -> Result<Self, SurveyError> {
        let model = ply::of_model(folder)?;
        let cameras = Dataset::cameras(folder)?;
        let frame = LocalFrame::of(cameras.iter());
        let scene = Self { model, cameras, frame };
        let (splats, sh_degree) = ply::size(&scene.model)?;
        check_memory(splats, sh_degree, &scene.local_cameras(), None, memory_bytes)?;
        let viewing = Viewing { splats, sh_degree, size_px: PICTURE_PX };
        let needed_bytes = viewing.bytes(viewing.usual_pairs());
        if needed_bytes > memory_bytes {
            return Err(MeshError::TooLittleMemory { splats, needed_bytes, memory_bytes }.into());
        }
        Ok(scene)
    }

    /// Fuses the mesh.
    pub(super) fn mesh(
        &self,
        memory_bytes: u64,
        threads: usize,
        mut on_event: impl FnMut(FuseEvent),
    ) -> Result<Relief, SurveyError> {
        let splats = ply::read(&self.model, &self.frame)?;
        let settings = FuseSettings { voxel_m: None, memory_bytes };
        let fused = mesh_model(splats, &self.local_cameras(), None, &settings, threads, |event| {
            on_event(event);
            ControlFlow::Continue(())
        });
        let fused = fused.map_err(SurveyError::from)?;
        Ok(Relief { voxel_m: fused.voxel_m * self.frame.unit(), mesh: fused.mesh })
    }

    /// The splats, without those that float above the surface: no camera looks straight down from above them, so nothing
    /// in training removed them, and on a map they would hide the ground.
    pub(super) fn splats_of(&self, surface: &Surface, voxel_m: f64) -> Result<Kept, SceneError> {
        let splats = ply::read(&self.model, &self.frame)?;
        let floats = |mean: &[f32; 3]| {
            let at = self.frame.world_from_local(DVec3::from_array(mean.map(f64::from)));
            match surface.highest_near(at.truncate(), BESIDE_VOXELS * voxel_m) {
                Some(highest_m) => at.z > highest_m + FLOATING_VOXELS * voxel_m,
                None => at.z > surface.lowest_eye_m,
            }
        };
        let floating: Vec<u32> = (0..splats.len() as u32)
            .into_par_iter()
            .filter(|splat| floats(&splats.means[*splat as usize]))
            .collect();
        Ok(Kept { splats: splats.without(&floating), left_out: floating.len() })
    }

    fn local_cameras(&self) -> Vec<Camera> {
        self.cameras.iter().map(|camera| self.frame.local_camera(camera)).collect()
    }
}
