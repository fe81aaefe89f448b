//! The fusion: runs its stages, and repeats them with larger voxels until the mesh fits into the memory. If the volume does
//! not fit, its blocks are fused in several parts, one after the other, to the same mesh.

use std::ops::ControlFlow;

use cosurf_scene::{Camera, LocalFrame, Mesh};
use tracing::debug_span;

use super::budget::VolumeBudget;
use super::error::MeshError;
use super::event::{FuseEvent, Stage};
use super::extract::{Extraction, Layout};
use super::frame::Frame;
use super::keeper::{InMemory, Keeper};
use super::painter::Painter;
use super::parts;
use super::scout::{self, PixelSize};
use super::volume::{Key, Volume};

/// Factor by which voxels grow if the memory is too small. The surface then passes through 0.63 times as many
/// blocks.
const COARSER: f64 = 1.26;

/// Settings of a fusion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FuseSettings {
    /// Edge length of a voxel, world units; `None` for the size of a pixel on the surface, see [`fuse`].
    pub voxel_m: Option<f64>,
    /// Limit on the bytes of the fusion; those of the renderer are not included.
    pub memory_bytes: u64,
}

/// A fused surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Fused<M = Mesh> {
    /// The mesh, with normals, colours and at least one triangle. Triangles are counter-clockwise as seen
    /// from outside.
    pub mesh: M,
    /// Edge length of a voxel, world units.
    pub voxel_m: f64,
    /// Size of a pixel at the depth of the surface, world units; the median over the views.
    pub pixel_m: f64,
    /// Number of blocks; each has 8³ voxels.
    pub blocks: usize,
    /// Number of parts that the blocks were fused in.
    pub parts: usize,
    /// Largest number of bytes that the volume of a part and the mesh took together.
    pub peak_bytes: u64,
}

impl Fused {
    /// Maps a surface that was fused in a local frame into the world.
    pub fn out_of_frame(self, frame: &LocalFrame) -> Self {
        let fused = self.in_units(frame.unit());
        Self { mesh: fused.mesh.out_of_frame(frame), ..fused }
    }
}

impl<M> Fused<M> {
    /// The same with lengths in other units. `unit` is the length of one of the old units in new ones.
    pub(super) fn in_units(self, unit: f64) -> Self {
        Self { voxel_m: self.voxel_m * unit, pixel_m: self.pixel_m * unit, ..self }
    }

    /// The same figures, with what `make` makes of the mesh.
    pub fn try_map<N, E>(self, make: impl FnOnce(M) -> Result<N, E>) -> Result<Fused<N>, E> {
        let Self { mesh, voxel_m, pixel_m, blocks, parts, peak_bytes } = self;
        Ok(Fused { mesh: make(mesh)?, voxel_m, pixel_m, blocks, parts, peak_bytes })
    }
}

/// Fuses the renderings that `painter` makes for the cameras into a mesh. The fusion skips these pixels:
/// - pixels whose alpha or depth shows no surface;
/// - pixels of which no neighbour in the row, or none in the column, shows a surface;
/// - pixels that see the surface at a grazing angle;
/// - pixels so far away that they cover more than four times the usual size.
///
/// By default, a voxel is as large as a pixel on the surface in the median view. Voxels become larger if
/// the mesh takes too much memory; how much memory there is changes nothing else. If `on_event` returns `Break`, the fusion ends with [`MeshError::Stopped`].
pub fn fuse(
    cameras: &[Camera],
    painter: impl Painter,
    settings: &FuseSettings,
    on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Fused, MeshError> {
    fuse_into(&mut InMemory, cameras, painter, settings, on_event)
}

/// As [`fuse()`], with what `keeper` makes of the mesh.
pub(super) fn fuse_into<K: Keeper>(
    keeper: &mut K,
    cameras: &[Camera],
    mut painter: impl Painter,
    settings: &FuseSettings,
    mut on_event: impl FnMut(FuseEvent) -> ControlFlow<()>,
) -> Result<Fused<K::Made>, MeshError> {
    let mut on_event = |event| match on_event(event) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(MeshError::Stopped),
    };
    if cameras.is_empty() {
        return Err(MeshError::NoCameras);
    }
    let budget = VolumeBudget::new(settings.memory_bytes, cameras, K::BYTES);
    let pixel_m = scout::pixel_m(cameras, &mut painter, &mut on_event)?.ok_or(MeshError::NoSurface)?;
    let pixel = PixelSize { usual_m: pixel_m, most_m: scout::FARTHEST * pixel_m };
    let wanted_m = settings.voxel_m.unwrap_or(pixel_m);
    let mut voxel_m = wanted_m;
    loop {
        let stages = Stages { cameras, pixel, voxel_m, budget };
        match stages.run(keeper, &mut painter, &mut on_event)? {
            Some(fused) => return Ok(fused),
            None => voxel_m *= COARSER,
        }
        keeper.forget()?;
        on_event(FuseEvent::Coarser { wanted_m, voxel_m })?;
    }
}

/// A fusion with voxels of one size.
struct Stages<'a> {
    cameras: &'a [Camera],
    pixel: PixelSize,
    voxel_m: f64,
    budget: VolumeBudget,
}

impl Stages<'_> {
    /// Runs all stages. Returns `None` if the mesh takes too much memory.
    fn run<K: Keeper>(
        &self,
        keeper: &mut K,
        painter: &mut impl Painter,
        on_event: &mut impl FnMut(FuseEvent) -> Result<(), MeshError>,
    ) -> Result<Option<Fused<K::Made>>, MeshError> {
        let Self { cameras, pixel, voxel_m, budget } = *self;
        let find = || scout::find_blocks(cameras, painter, pixel, voxel_m, budget.blocks_max, on_event);
        let Some(keys) = debug_span!("find_blocks", voxel_m).in_scope(find)? else {
            return Ok(None);
        };
        if keys.is_empty() {
            return Err(MeshError::NoSurface);
        }
        let parts = parts::divide(&keys, budget.part_max(keys.len()));
        let (mut extraction, mut peak_bytes) = (Extraction::default(), 0);
        for (part, own) in parts.iter().enumerate() {
            let done = [part, parts.len()].map(|parts| parts * cameras.len());
            let parts::Part { keys, own } = parts::part(&keys, own.clone());
            let volume = self.fuse(keys, painter, |views| {
                on_event(FuseEvent::Progress { stage: Stage::Fuse, done: done[0] + views, of: done[1] })
            })?;
            let _span = debug_span!("extract", blocks = own).entered();
            let layout = Layout::new(&volume, own, extraction.counts());
            let bytes = volume.bytes() + K::made_bytes(&layout) + extraction.pending_bytes();
            peak_bytes = bytes.max(K::end_bytes(&layout)).max(peak_bytes);
            if peak_bytes > budget.volume_bytes || !layout.fits_indices() {
                return Ok(None);
            }
            extraction.add(&volume, &layout);
            keeper.keep(&mut extraction)?;
        }
        let mesh = keeper.finish(extraction, budget.volume_bytes, on_event)?;
        let (blocks, parts) = (keys.len(), parts.len());
        Ok(Some(Fused { mesh, voxel_m, pixel_m: pixel.usual_m, blocks, parts, peak_bytes }))
    }

    /// Fuses all views into the blocks of `keys`. Views that touch none of them are not rendered.
    fn fuse(
        &self,
        keys: Vec<Key>,
        painter: &mut impl Painter,
        mut on_view: impl FnMut(usize) -> Result<(), MeshError>,
    ) -> Result<Volume, MeshError> {
        let _span = debug_span!("fuse", views = self.cameras.len(), blocks = keys.len()).entered();
        let mut volume = Volume::new(keys, self.voxel_m);
        let views: Vec<(&Camera, bool)> =
            self.cameras.iter().map(|camera| (camera, volume.is_in_view(&Frame::of(camera)))).collect();
        painter.expect(views.iter().filter(|(_, seen)| *seen).map(|(camera, _)| **camera).collect());
        for (i, (camera, seen)) in views.into_iter().enumerate() {
            if seen {
                volume.fuse(&Frame::new(camera, &painter.render(camera)?, self.pixel.most_m));
            }
            on_view(i + 1)?;
        }
        Ok(volume)
    }
}
