//! From rendered depth to a mesh: truncated signed distances are fused in a sparse volume of small
//! blocks (Curless and Levoy 1996; blocks as in Nießner et al. 2013), of which marching cubes makes
//! triangles.
//!
//! First a look at the surface with small pictures says how large voxels should be and which blocks
//! the surface passes through; then, all sizes known, the volume is allocated once and every view is
//! fused into it, one after the other, its blocks in parallel. So the mesh has the same bytes for any
//! number of threads, and memory is a promise: where it does not suffice, voxels become larger.
//!
//! What it refuses to know: who renders. [`fuse`] takes a function from cameras to [`Rendering`]s.
//!
//! Where to start reading: [`fuse`], then `volume`, `extract`.

mod cases;
mod clean;
mod extract;
mod frame;
mod model;
mod plan;
mod scout;
#[cfg(test)]
mod tests;
mod volume;

use cosurf_engine::Rendering;
use cosurf_scene::{Camera, Mesh};

use extract::Layout;
use frame::Frame;
pub use model::mesh_model;
use plan::Plan;
use scout::PixelSize;
use volume::Volume;

/// By how much voxels grow where the memory does not suffice: their surface then takes 0.63 times as
/// many blocks.
const COARSER: f64 = 1.26;

/// What a fusion should be like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FuseSettings {
    /// Edge of a voxel in world units; by default what a pixel covers of the surface, see [`fuse`].
    pub voxel_m: Option<f64>,
    /// The most bytes to take, those of the renderer not included.
    pub memory_bytes: u64,
}

/// A fused surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Fused {
    /// Shared vertices with normals and colours, outside counter-clockwise; never without triangles.
    pub mesh: Mesh,
    /// Edge of a voxel, world units.
    pub voxel_m: f64,
    /// Median over the views of what a pixel covers at the surface's depth, world units.
    pub pixel_m: f64,
    /// Blocks of 8³ voxels that the volume had.
    pub blocks: usize,
    /// Bytes that the volume and the mesh took at most.
    pub peak_bytes: u64,
}

/// What a fusion is about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FuseEvent {
    /// A stage has done with some of its views.
    Progress {
        /// What is being done.
        stage: Stage,
        /// Views done.
        done: usize,
        /// Views in all.
        of: usize,
    },
    /// The memory does not suffice for voxels of the size wanted.
    Coarser {
        /// Edge of a voxel as it was to be, world units.
        wanted_m: f64,
        /// As it will be.
        voxel_m: f64,
    },
}

/// The stages of a fusion that go through all views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// How far away the surface is.
    Look,
    /// Which blocks it passes through.
    Find,
    /// Signed distances.
    Fuse,
}

/// Why there is no mesh.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// Nothing to look with.
    #[error("there are no cameras to look at the model with")]
    NoCameras,
    /// No view shows anything.
    #[error(
        "no view shows a surface: the model is empty, or these cameras look elsewhere; use the cameras that it was trained with"
    )]
    NoSurface,
    /// What the views show does not agree.
    #[error(
        "the views agree on no surface: all that was found are specks; use more views, or larger voxels (--voxel)"
    )]
    NoAgreement,
    /// Not even the renderer fits.
    #[error("the model with {splats} splats needs {} of memory to be rendered, but may take {}; allow more memory (--memory)", cosurf_scene::bytes::format_bytes(*needed_bytes), cosurf_scene::bytes::format_bytes(*memory_bytes))]
    TooLittleMemory {
        /// In the model.
        splats: usize,
        /// The least that would do.
        needed_bytes: u64,
        /// What was given.
        memory_bytes: u64,
    },
}

/// Fuses what `render` shows of each camera to a mesh. Pixels are skipped where alpha or depth says
/// that there is no surface, where it is seen at a grazing angle or ends, and where it is so far away
/// that a pixel covers more than four times what is usual.
///
/// Voxels are as large as the surface that a pixel covers in the median view, unless `settings` say
/// otherwise; larger where that takes too much memory.
pub fn fuse(
    cameras: &[Camera],
    mut render: impl FnMut(&Camera) -> Rendering,
    settings: &FuseSettings,
    mut on_event: impl FnMut(FuseEvent),
) -> Result<Fused, MeshError> {
    if cameras.is_empty() {
        return Err(MeshError::NoCameras);
    }
    let plan = Plan::new(settings.memory_bytes, cameras);
    let pixel_m = scout::pixel_m(cameras, &mut render, &mut on_event).ok_or(MeshError::NoSurface)?;
    let pixel = PixelSize { usual_m: pixel_m, most_m: scout::FARTHEST * pixel_m };
    let wanted_m = settings.voxel_m.unwrap_or(pixel_m);
    let mut voxel_m = wanted_m;
    loop {
        let stages = Stages { cameras, pixel, voxel_m, plan };
        match stages.run(&mut render, &mut on_event)? {
            Some(fused) => return Ok(fused),
            None => voxel_m *= COARSER,
        }
        on_event(FuseEvent::Coarser { wanted_m, voxel_m });
    }
}

/// A fusion with voxels of one size.
struct Stages<'a> {
    cameras: &'a [Camera],
    pixel: PixelSize,
    voxel_m: f64,
    plan: Plan,
}

impl Stages<'_> {
    /// The mesh; `None` where it or the volume takes too much memory.
    fn run(
        &self,
        render: &mut impl FnMut(&Camera) -> Rendering,
        on_event: &mut impl FnMut(FuseEvent),
    ) -> Result<Option<Fused>, MeshError> {
        let Self { cameras, pixel, voxel_m, plan } = *self;
        let Some(keys) = scout::find_blocks(cameras, render, pixel, voxel_m, plan.blocks_max, on_event)
        else {
            return Ok(None);
        };
        if keys.is_empty() {
            return Err(MeshError::NoSurface);
        }
        let mut volume = Volume::new(keys, voxel_m);
        for (i, camera) in cameras.iter().enumerate() {
            volume.fuse(&Frame::new(camera, &render(camera), pixel.most_m));
            on_event(FuseEvent::Progress { stage: Stage::Fuse, done: i + 1, of: cameras.len() });
        }
        let layout = Layout::new(&volume);
        let (blocks, peak_bytes) = (volume.len(), volume.bytes() + layout.bytes());
        if peak_bytes > plan.volume_bytes || !layout.fits_indices() {
            return Ok(None);
        }
        let mut mesh = extract::extract(&volume, &layout);
        drop((volume, layout));
        clean::remove_specks(&mut mesh);
        if mesh.triangles.is_empty() {
            return Err(MeshError::NoAgreement);
        }
        mesh.normals = clean::normals(&mesh);
        Ok(Some(Fused { mesh, voxel_m, pixel_m: pixel.usual_m, blocks, peak_bytes }))
    }
}
