//! Renders a splat model for a mesh, within one memory limit for rendering and fusion together. The model need not fit into
//! the memory.

use std::collections::HashSet;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use cosurf_engine::{Place, Rendering, ViewError, ViewMemory, Views};
use cosurf_scene::{Camera, LocalFrame, MeshCounts, Pose};
use glam::DVec2;
use tracing::info_span;

use super::budget;
use super::error::MeshError;
use super::event::FuseEvent;
use super::files::InFiles;
use super::fuse::{FuseSettings, Fused, fuse_into};
use super::keeper::{InMemory, Keeper};
use super::painter::Painter;
use super::scout::FIND_LEAST_PX;

/// What a mesh is made of: a splat model, and the cameras to render it from.
#[derive(Clone, Debug)]
pub struct MeshSource<'a> {
    /// The PLY file of the model.
    pub model: PathBuf,
    /// The frame into which the model is moved. The mesh is in it.
    pub frame: &'a LocalFrame,
    /// The cameras from which the model is rendered, in the frame.
    pub cameras: &'a [Camera],
    /// The largest long side of a picture, px; `None` for the cameras' size.
    pub max_size_px: Option<u32>,
}

/// Renders the model from every camera, and fuses the renderings into a mesh. `settings.memory_bytes` limits the whole process.
/// The model need not fit into the memory; if the splats that a single picture shows do not fit, pictures shrink. Rendering uses
/// `threads` (at least 1) threads; the fusion uses rayon's pool. If `on_event` returns `Break`, the result is
/// [`MeshError::Stopped`].
pub fn mesh_file(
    source: &MeshSource,
    settings: &FuseSettings,
    threads: usize,
    on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Fused, MeshError> {
    made(&mut InMemory, source, settings, threads, on_event)
}

/// As [`mesh_file`], and writes the mesh as a PLY in the world, whose bytes are those of [`mesh_file`]'s mesh. The mesh need not
/// fit into the memory: while it grows, it is in temporary files in the folder of `out`. Lengths in the result are in world units.
pub fn mesh_to_ply(
    source: &MeshSource,
    settings: &FuseSettings,
    threads: usize,
    out: &Path,
    on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Fused<MeshCounts>, MeshError> {
    let mut files = InFiles::new(out, source.frame)?;
    Ok(made(&mut files, source, settings, threads, on_event)?.in_units(source.frame.unit()))
}

fn made<K: Keeper>(
    keeper: &mut K,
    source: &MeshSource,
    settings: &FuseSettings,
    threads: usize,
    on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Fused<K::Made>, MeshError> {
    let MeshSource { model, frame, cameras, max_size_px } = source;
    let mut views = open(model.clone(), frame, threads)?;
    let _span = info_span!("mesh", splats = views.splats()).entered();
    let max_size_px = max_size_px.unwrap_or(u32::MAX);
    let memory_bytes = settings.memory_bytes;
    let Fitted { cameras, pictures_bytes, beside_bytes: fusion_bytes } =
        fit(&mut views, cameras, max_size_px, memory_bytes, budget::least_bytes)?;
    // With more memory for pictures, the file is read for more cameras at once.
    let pictures_bytes = pictures_bytes + (memory_bytes - pictures_bytes - fusion_bytes) / 2;
    let settings = FuseSettings { memory_bytes: memory_bytes - pictures_bytes, ..*settings };
    fuse_into(keeper, &cameras, FilePainter(views.limited(pictures_bytes)), &settings, on_event)
}

/// Renders the model in the PLY file `path`, moved into `frame`, from every camera, each once, and calls `visit` with the
/// number of renderings so far and in all, the camera, as it was rendered, and the rendering. The process takes at most
/// `memory_bytes`, of which the caller holds `held_bytes` meanwhile; if the rest is too little for a picture, they shrink.
pub(crate) fn render_each<E: From<MeshError>>(
    path: PathBuf,
    frame: &LocalFrame,
    cameras: &[Camera],
    memory_bytes: u64,
    held_bytes: u64,
    threads: usize,
    mut visit: impl FnMut([usize; 2], &Camera, &Rendering) -> Result<(), E>,
) -> Result<(), E> {
    let mut views = open(path, frame, threads)?;
    let beside = |cameras: &[Camera]| held_bytes + budget::frame_bytes(cameras);
    let Fitted { cameras, beside_bytes, .. } = fit(&mut views, cameras, u32::MAX, memory_bytes, beside)?;
    let mut painter = FilePainter(views.limited(memory_bytes - beside_bytes));
    painter.expect(cameras.clone());
    let of = cameras.len();
    let mut render = |(i, camera)| visit([i + 1, of], camera, &painter.render(camera)?);
    cameras.iter().enumerate().try_for_each(&mut render)
}

fn open(path: PathBuf, frame: &LocalFrame, threads: usize) -> Result<Views, MeshError> {
    let memory = ViewMemory { limit_bytes: 0, held_bytes: || 0, made_bytes: 0, made_bytes_per_pixel: 0 };
    let views = Views::open(path, frame, Place::Within(memory), threads)?;
    if views.splats() == 0 { Err(MeshError::NoSurface) } else { Ok(views) }
}

/// Cameras whose pictures are small enough for the memory, and the least bytes for rendering them and beside it.
struct Fitted {
    cameras: Vec<Camera>,
    pictures_bytes: u64,
    beside_bytes: u64,
}

impl Fitted {
    /// The cameras with pictures of at most this long side. Reads the file once. `beside` tells for cameras how many
    /// bytes are needed beside rendering.
    fn of(
        views: &mut Views,
        cameras: &[Camera],
        long_side_px: u32,
        beside: impl Fn(&[Camera]) -> u64,
    ) -> Result<Self, MeshError> {
        let cameras: Vec<Camera> = cameras.iter().map(|camera| camera.fitted(long_side_px)).collect();
        // A small picture shows a few splats more than a large one, because each splat is at least a pixel wide.
        let small = cameras.iter().map(|camera| camera.fitted(FIND_LEAST_PX));
        let of_all_sizes: Vec<Camera> = cameras.iter().copied().chain(small).collect();
        let pictures_bytes = views.needed_bytes(&of_all_sizes)?;
        let beside_bytes = beside(&cameras);
        Ok(Self { cameras, pictures_bytes, beside_bytes })
    }

    fn needed_bytes(&self) -> u64 {
        self.pictures_bytes + self.beside_bytes
    }
}

/// Leaves out cameras that are there twice, and shrinks the pictures until they and what `beside` tells for their cameras
/// fit into the memory. A memory that is too small even for the smallest pictures is told before all sizes are tried.
fn fit(
    views: &mut Views,
    cameras: &[Camera],
    max_size_px: u32,
    memory_bytes: u64,
    beside: impl Fn(&[Camera]) -> u64,
) -> Result<Fitted, MeshError> {
    let cameras = without_twins(cameras);
    let longest = cameras.iter().map(|camera| camera.size_px[0].max(camera.size_px[1])).max();
    let mut long_side_px = longest.unwrap_or(0).min(max_size_px);
    let largest = Fitted::of(views, &cameras, long_side_px, &beside)?;
    if largest.needed_bytes() <= memory_bytes {
        return Ok(largest);
    }
    let smallest = Fitted::of(views, &cameras, FIND_LEAST_PX, &beside)?;
    let needed_bytes = smallest.needed_bytes();
    if needed_bytes > memory_bytes {
        return Err(MeshError::TooLittleMemory { splats: views.splats(), needed_bytes, memory_bytes });
    }
    loop {
        long_side_px = long_side_px * 7 / 8;
        if long_side_px <= FIND_LEAST_PX {
            return Ok(smallest);
        }
        let fitted = Fitted::of(views, &cameras, long_side_px, &beside)?;
        if fitted.needed_bytes() <= memory_bytes {
            return Ok(fitted);
        }
    }
}

/// A [`Painter`] that renders a model in a file.
struct FilePainter(Views);

impl Painter for FilePainter {
    fn expect(&mut self, cameras: Vec<Camera>) {
        self.0.expect(cameras);
    }

    fn render(&mut self, camera: &Camera) -> Result<Rendering, MeshError> {
        self.0.render(camera).map_err(|error| match error {
            ViewError::Scene(error) => error.into(),
            error => MeshError::View(error),
        })
    }
}

/// The cameras, each once: two agents that trained on the same picture both send its camera.
fn without_twins(cameras: &[Camera]) -> Vec<Camera> {
    let numbers = |camera: &Camera| {
        let Pose { rotation, translation } = camera.cam_from_world;
        let lens = [camera.focal_px, camera.center_px].map(|two: DVec2| two.to_array().map(f64::to_bits));
        let rotation = rotation.to_array().map(f64::to_bits);
        (rotation, translation.to_array().map(f64::to_bits), lens, camera.size_px)
    };
    let mut seen = HashSet::new();
    cameras.iter().copied().filter(|camera| seen.insert(numbers(camera))).collect()
}
