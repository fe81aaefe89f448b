//! The model in a folder: its cameras, its mesh, and its splats.
//!
//! What it knows nothing about: maps.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use cosurf_scene::{Camera, Dataset, LocalFrame, Mesh, Splats, model, ply};

use super::depths::DepthMap;
use super::error::SurveyError;
use crate::mesh::{FuseEvent, FuseSettings, MeshSource, mesh_file, render_each};

/// A model that has not been read.
#[derive(Debug)]
pub(super) struct Scene {
    model: PathBuf,
    /// The cameras, in the world.
    pub(super) cameras: Vec<Camera>,
    /// The frame to compute in.
    pub(super) frame: LocalFrame,
}

/// A mesh that was fused from the model already.
#[derive(Clone, Debug)]
pub struct FusedMesh {
    /// The file, a PLY in the world.
    pub file: PathBuf,
    /// Edge length of the voxels it was fused in, metres, above 0.
    pub voxel_m: f64,
}

/// The surface of a model.
#[derive(Debug)]
pub(super) struct Relief {
    /// In the frame of the scene.
    pub(super) mesh: Mesh,
    /// Edge length of a voxel, metres.
    pub(super) voxel_m: f64,
}

impl Scene {
    /// Reads the cameras.
    pub(super) fn open(folder: &Path) -> Result<Self, SurveyError> {
        let model = ply::of_model(folder)?;
        let cameras = Dataset::cameras(folder)?;
        let frame = LocalFrame::of(cameras.iter());
        Ok(Self { model, cameras, frame })
    }

    /// Reads the mesh.
    pub(super) fn read_mesh(&self, of: &FusedMesh) -> Result<Relief, SurveyError> {
        let mut mesh = Mesh::read(&of.file)?.into_frame(&self.frame);
        mesh.normals = Vec::new(); // nothing here needs them
        Ok(Relief { mesh, voxel_m: of.voxel_m })
    }

    /// Fuses the mesh.
    pub(super) fn fuse_mesh(
        &self,
        memory_bytes: u64,
        threads: usize,
        mut on_event: impl FnMut(FuseEvent),
    ) -> Result<Relief, SurveyError> {
        let settings = FuseSettings { voxel_m: None, memory_bytes };
        let (model, cameras) = (self.model.clone(), self.local_cameras());
        let source = MeshSource { model, frame: &self.frame, cameras: &cameras, max_size_px: None };
        let fused = mesh_file(&source, &settings, threads, |event| {
            on_event(event);
            ControlFlow::Continue(())
        });
        let mut fused = fused.map_err(SurveyError::from)?;
        fused.mesh.normals = Vec::new(); // nothing here needs them
        Ok(Relief { voxel_m: fused.voxel_m * self.frame.unit(), mesh: fused.mesh })
    }

    /// Calls `visit` with the number of renderings so far and in all, and what each camera shows. Pictures shrink to fit into
    /// the memory, beside the `held_bytes` that the caller holds meanwhile.
    pub(super) fn render_each(
        &self,
        memory_bytes: u64,
        held_bytes: u64,
        threads: usize,
        mut visit: impl FnMut([usize; 2], &DepthMap) -> Result<(), SurveyError>,
    ) -> Result<(), SurveyError> {
        let (model, cameras) = (self.model.clone(), self.local_cameras());
        let unit_m = self.frame.unit();
        render_each(
            model,
            &self.frame,
            &cameras,
            memory_bytes,
            held_bytes,
            threads,
            |counts, camera, rendering| {
                visit(counts, &DepthMap::of(&self.frame.world_camera(camera), rendering, unit_m))
            },
        )
    }

    /// Calls `visit` with all splats, in the frame of the scene, at most `most` at a time.
    pub(super) fn splats(&self, most: usize, visit: impl FnMut(&Splats)) -> Result<(), SurveyError> {
        Ok(model::read_parts(&self.model, &self.frame, most, visit)?)
    }

    /// As [`Self::splats`], in metres about the origin of that frame.
    pub(super) fn splats_in_metres(
        &self,
        most: usize,
        visit: impl FnMut(&Splats),
    ) -> Result<(), SurveyError> {
        Ok(model::read_parts(&self.model, &LocalFrame::at(self.frame.origin()), most, visit)?)
    }

    /// Degree of the spherical harmonics of the splats, 0 to 3.
    pub(super) fn sh_degree(&self) -> Result<u32, SurveyError> {
        Ok(model::size(&self.model)?.1)
    }

    /// World height of the lowest camera, metres.
    pub(super) fn lowest_eye_m(&self) -> f64 {
        self.cameras.iter().map(|camera| camera.cam_from_world.center().z).fold(f64::INFINITY, f64::min)
    }

    fn local_cameras(&self) -> Vec<Camera> {
        self.cameras.iter().map(|camera| self.frame.local_camera(camera)).collect()
    }
}
