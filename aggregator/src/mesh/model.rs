//! Makes a mesh from a splat model, within one memory limit for rendering and fusion together. A model that takes too much
//! of it is rendered from its file, for a few cameras at a time.

use std::collections::HashSet;
use std::ops::ControlFlow;
use std::path::PathBuf;

use cosurf_engine::backend::{Backend, Channels, Rendering};
use cosurf_engine::budget::{Costs, PAIRS_PER_SPLAT, PROCESS_BYTES};
use cosurf_engine::{Capacity, CpuBackend, Place, ViewError, ViewMemory, Views};
use cosurf_scene::{Camera, LocalFrame, Pose, Splats};
use glam::DVec2;
use tracing::info_span;

use super::budget;
use super::error::MeshError;
use super::event::FuseEvent;
use super::fuse::{FuseSettings, Fused, fuse};
use super::painter::Painter;
use super::scout::FIND_LEAST_PX;

/// Capacity for splat–tile pairs, per splat. Meshing renders oblique views of the whole model, so it allows three times
/// as many pairs as training. A view with more pairs loses its farthest splats. Other views see the surface of these
/// splats better.
const PAIRS_PER_MESHED_SPLAT: usize = 3 * PAIRS_PER_SPLAT;
/// Least capacity for splat–tile pairs, for models of few splats.
const PAIRS_LEAST: usize = 1 << 18;
/// Bytes per pixel of a [`Rendering`]: colour, alpha, depth and normal. They count twice, because its vectors are
/// reallocated while they grow.
const RENDERING_BYTES_PER_PIXEL: u64 = 2 * 32;
/// Pictures take at most the memory that the splats leave, divided by this number.
const PICTURE_SHARE: u64 = 4;

/// Renders the splats from every camera, with a long side of at most `max_size_px`, and fuses the renderings into a
/// mesh. `settings.memory_bytes` limits the whole process. If it is too small, pictures shrink and voxels grow.
/// Rendering uses `threads` (at least 1) threads; the fusion uses rayon's pool. If `on_event` returns `Break`, the result is
/// [`MeshError::Stopped`].
pub fn mesh_model(
    splats: Splats,
    cameras: &[Camera],
    max_size_px: Option<u32>,
    settings: &FuseSettings,
    threads: usize,
    on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Fused, MeshError> {
    if splats.is_empty() {
        return Err(MeshError::NoSurface);
    }
    let _span = info_span!("mesh", splats = splats.len()).entered();
    let needs = Needs::of(splats.len(), splats.sh_degree);
    let cameras =
        fitted(&needs, &without_twins(cameras), max_size_px.unwrap_or(u32::MAX), settings.memory_bytes)?;
    let left = settings.memory_bytes - needs.bytes(&cameras);
    let mut renderer = BoundedRenderer::new(splats, &needs, threads);
    let settings = FuseSettings { memory_bytes: left + budget::frame_bytes(&cameras), ..*settings };
    fuse(&cameras, |camera: &Camera| renderer.render(camera), &settings, on_event)
}

/// Renders the model in the PLY file `path`, moved into `frame`, from every camera, with a long side of at most `max_size_px`,
/// and fuses the renderings into a mesh. `settings.memory_bytes` limits the whole process. The model need not fit into the
/// memory; if the splats that a single picture shows do not fit, pictures shrink. Rendering uses `threads` (at least 1)
/// threads; the fusion uses rayon's pool. If `on_event` returns `Break`, the result is [`MeshError::Stopped`].
pub fn mesh_file(
    path: PathBuf,
    frame: &LocalFrame,
    cameras: &[Camera],
    max_size_px: Option<u32>,
    settings: &FuseSettings,
    threads: usize,
    on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Fused, MeshError> {
    let memory = ViewMemory { limit_bytes: 0, held_bytes: || 0, made_bytes: 0, made_bytes_per_pixel: 0 };
    let mut views = Views::open(path, frame, Place::Within(memory), threads)?;
    if views.splats() == 0 {
        return Err(MeshError::NoSurface);
    }
    let _span = info_span!("mesh", splats = views.splats()).entered();
    let Fitted { cameras, pictures_bytes, fusion_bytes } =
        fit(&mut views, &without_twins(cameras), max_size_px.unwrap_or(u32::MAX), settings.memory_bytes)?;
    // With more memory for pictures, the file is read for more cameras at once.
    let pictures_bytes = pictures_bytes + (settings.memory_bytes - pictures_bytes - fusion_bytes) / 2;
    let settings = FuseSettings { memory_bytes: settings.memory_bytes - pictures_bytes, ..*settings };
    fuse(&cameras, FilePainter(views.limited(pictures_bytes)), &settings, on_event)
}

/// Cameras whose pictures are small enough for the memory, and the least bytes for rendering and fusing them.
struct Fitted {
    cameras: Vec<Camera>,
    pictures_bytes: u64,
    fusion_bytes: u64,
}

/// Shrinks the pictures until they fit into the memory.
fn fit(
    views: &mut Views,
    cameras: &[Camera],
    max_size_px: u32,
    memory_bytes: u64,
) -> Result<Fitted, MeshError> {
    let longest = cameras.iter().map(|camera| camera.size_px[0].max(camera.size_px[1])).max();
    let mut long_side_px = longest.unwrap_or(0).min(max_size_px);
    loop {
        let cameras: Vec<Camera> = cameras.iter().map(|camera| camera.fitted(long_side_px)).collect();
        // A small picture shows a few splats more than a large one, because each splat is at least a pixel wide.
        let small = cameras.iter().map(|camera| camera.fitted(FIND_LEAST_PX));
        let of_all_sizes: Vec<Camera> = cameras.iter().copied().chain(small).collect();
        let pictures_bytes = views.needed_bytes(&of_all_sizes)?;
        let fusion_bytes = budget::least_bytes(&cameras);
        let needed_bytes = pictures_bytes + fusion_bytes;
        if needed_bytes <= memory_bytes {
            return Ok(Fitted { cameras, pictures_bytes, fusion_bytes });
        }
        if long_side_px <= FIND_LEAST_PX {
            return Err(MeshError::TooLittleMemory { splats: views.splats(), needed_bytes, memory_bytes });
        }
        long_side_px = long_side_px * 7 / 8;
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

/// Renders the splats from every camera, each once, and calls `visit` with the camera, as it was rendered, and the
/// rendering. `memory_bytes` limits the whole process; if it is too small, pictures shrink.
pub fn render_each<E: From<MeshError>>(
    splats: Splats,
    cameras: &[Camera],
    memory_bytes: u64,
    threads: usize,
    mut visit: impl FnMut(&Camera, &Rendering) -> Result<(), E>,
) -> Result<(), E> {
    if splats.is_empty() {
        return Err(MeshError::NoSurface.into());
    }
    let needs = Needs::of(splats.len(), splats.sh_degree);
    let cameras = fitted(&needs, &without_twins(cameras), u32::MAX, memory_bytes)?;
    let mut renderer = BoundedRenderer::new(splats, &needs, threads);
    cameras.iter().try_for_each(|camera| visit(camera, &renderer.render(camera)))
}

/// An error if a model with this many splats and this degree of spherical harmonics takes more memory than the whole process
/// may. [`mesh_model`] would give the same error, but only when the splats are in memory.
pub(crate) fn check_memory(
    splats: usize,
    sh_degree: u32,
    cameras: &[Camera],
    max_size_px: Option<u32>,
    memory_bytes: u64,
) -> Result<(), MeshError> {
    let needs = Needs::of(splats, sh_degree);
    fitted(&needs, cameras, max_size_px.unwrap_or(u32::MAX), memory_bytes).map(drop)
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

/// Sizes of the renderer's buffers, and the bytes that the renderer needs.
struct Needs {
    splats: usize,
    pairs: usize,
    /// Bytes without those of pictures.
    bytes: u64,
}

impl Needs {
    fn of(splats: usize, sh_degree: u32) -> Self {
        let pairs = (PAIRS_PER_MESHED_SPLAT * splats).max(PAIRS_LEAST);
        // While the model is loaded, both the caller and the renderer hold its splats.
        let costs = Costs::of(&Capacity::to_render(sh_degree), None);
        let per_splat = costs.splat + Splats::bytes_per_splat(sh_degree);
        let bytes = PROCESS_BYTES + (splats * per_splat + pairs * costs.pair) as u64;
        Self { splats, pairs, bytes }
    }

    /// Bytes for rendering these cameras and for the view being fused.
    fn bytes(&self, cameras: &[Camera]) -> u64 {
        self.bytes + picture_bytes(cameras) + budget::frame_bytes(cameras)
    }
}

fn picture_bytes(cameras: &[Camera]) -> u64 {
    let of = |camera: &Camera| {
        let pixels = u64::from(camera.size_px[0]) * u64::from(camera.size_px[1]);
        let shape = Capacity { size_px: camera.size_px, ..Capacity::to_render(0) };
        Costs::of(&shape, None).pictures as u64 + pixels * RENDERING_BYTES_PER_PIXEL
    };
    cameras.iter().map(of).max().unwrap_or(0)
}

/// The cameras, scaled to pictures that are small enough for the memory.
fn fitted(
    needs: &Needs,
    cameras: &[Camera],
    max_size_px: u32,
    memory_bytes: u64,
) -> Result<Vec<Camera>, MeshError> {
    let shrunk = |long_side_px: u32| -> Vec<Camera> {
        cameras.iter().map(|camera| camera.fitted(long_side_px)).collect()
    };
    let longest = cameras.iter().map(|camera| camera.size_px[0].max(camera.size_px[1])).max();
    let mut long_side_px = longest.unwrap_or(0).min(max_size_px);
    loop {
        let cameras = shrunk(long_side_px);
        let left = memory_bytes.saturating_sub(needs.bytes);
        let pictures = picture_bytes(&cameras) + budget::frame_bytes(&cameras);
        if pictures <= left / PICTURE_SHARE && pictures + budget::least_bytes(&[]) <= left {
            return Ok(cameras);
        }
        if long_side_px <= FIND_LEAST_PX {
            let needed_bytes = needs.bytes + PICTURE_SHARE * pictures + budget::least_bytes(&[]);
            return Err(MeshError::TooLittleMemory { splats: needs.splats, needed_bytes, memory_bytes });
        }
        long_side_px = long_side_px * 7 / 8;
    }
}

/// A renderer whose buffers never grow.
struct BoundedRenderer {
    backend: CpuBackend,
    sh_degree: u32,
}

impl BoundedRenderer {
    fn new(splats: Splats, needs: &Needs, threads: usize) -> Self {
        let capacity =
            Capacity { splats: splats.len(), pairs: needs.pairs, ..Capacity::to_render(splats.sh_degree) };
        let mut backend = CpuBackend::new(capacity, threads);
        backend.load(&splats);
        Self { backend, sh_degree: splats.sh_degree }
    }

    fn render(&mut self, camera: &Camera) -> Rendering {
        self.backend.project(camera, self.sh_degree);
        self.backend.bin();
        self.backend.rasterize(Channels::Geometry);
        self.backend.rendering()
    }
}
