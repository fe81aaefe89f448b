//! The first pass, over smaller pictures: determines the size of voxels, and finds the blocks that the
//! surface passes through.

use std::collections::HashSet;

use cosurf_scene::Camera;
use rayon::prelude::*;

use super::error::MeshError;
use super::event::{FuseEvent, Stage};
use super::frame::Frame;
use super::painter::Painter;
use super::volume::{Key, blocks_around};

/// Long side of the pictures from which the distance of the surface is measured, px.
const LOOK_PX: u32 = 160;
/// To search for blocks, pictures are shrunk until a pixel of usual size covers this many voxels along each
/// axis. A block is eight voxels wide, so none is missed.
const VOXELS_PER_PIXEL: f64 = 2.0;
/// Pictures in which blocks are searched for are not smaller than this, px on their long side.
pub(super) const FIND_LEAST_PX: u32 = 64;
/// Largest size that a pixel may cover on the surface, as a multiple of the usual size. Larger pixels are not
/// fused.
pub(super) const FARTHEST: f64 = 4.0;

/// Size of a pixel on the surface, across the line of sight, world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PixelSize {
    /// Size in the median view, at the full size of the picture.
    pub(super) usual_m: f64,
    /// Largest size of a pixel that is trusted.
    pub(super) most_m: f64,
}

/// Size of a pixel on the surface, world units: in each view at the view's median depth, then the median over
/// the views. `None` if no view shows a surface.
pub(super) fn pixel_m(
    cameras: &[Camera],
    painter: &mut impl Painter,
    on_event: &mut impl FnMut(FuseEvent) -> Result<(), MeshError>,
) -> Result<Option<f64>, MeshError> {
    let mut sizes_m = Vec::with_capacity(cameras.len());
    let small = |camera: &Camera| camera.fitted(LOOK_PX);
    painter.expect(cameras.iter().map(small).collect());
    for (i, camera) in cameras.iter().enumerate() {
        let mut depths = painter.render(&small(camera))?.depth;
        depths.retain(|z| z.is_finite() && *z > 0.0);
        sizes_m.extend(median(&mut depths).map(|z| f64::from(z) / camera.focal_px.min_element()));
        on_event(FuseEvent::Progress { stage: Stage::Look, done: i + 1, of: cameras.len() })?;
    }
    let mut sizes_m: Vec<f32> = sizes_m.into_iter().map(|size| size as f32).collect();
    Ok(median(&mut sizes_m).map(f64::from))
}

fn median(values: &mut [f32]) -> Option<f32> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// The blocks within the truncation distance of the surface that the views show, ascending; `None` if there
/// are more than `blocks_max`.
pub(super) fn find_blocks(
    cameras: &[Camera],
    painter: &mut impl Painter,
    pixel: PixelSize,
    voxel_m: f64,
    blocks_max: usize,
    on_event: &mut impl FnMut(FuseEvent) -> Result<(), MeshError>,
) -> Result<Option<Vec<Key>>, MeshError> {
    let shrink = (pixel.usual_m / (VOXELS_PER_PIXEL * voxel_m)).min(1.0);
    let smaller = |camera: &Camera| {
        let long_side = f64::from(camera.size_px[0].max(camera.size_px[1]));
        camera.fitted(((long_side * shrink).ceil() as u32).max(FIND_LEAST_PX))
    };
    painter.expect(cameras.iter().map(smaller).collect());
    let mut found = HashSet::new();
    for (i, camera) in cameras.iter().enumerate() {
        let small = smaller(camera);
        // A pixel of a smaller picture covers more of the surface, so the limit on its size grows by the same
        // ratio.
        let ratio = camera.focal_px.min_element() / small.focal_px.min_element();
        let frame = Frame::new(&small, &painter.render(&small)?, pixel.most_m * ratio);
        found.extend(blocks_of(&frame, voxel_m));
        if found.len() > blocks_max {
            return Ok(None);
        }
        on_event(FuseEvent::Progress { stage: Stage::Find, done: i + 1, of: cameras.len() })?;
    }
    let mut keys: Vec<Key> = found.into_iter().collect();
    keys.sort_unstable();
    Ok(Some(keys))
}

/// The blocks near the surface that a view shows; some blocks may be repeated.
fn blocks_of(frame: &Frame, voxel_m: f64) -> Vec<Key> {
    let [width, height] = frame.size_px;
    let row = |y: usize| {
        let mut keys = Vec::new();
        for x in (0..width).filter(|x| frame.texels[y * width + x].weight > 0.0) {
            keys.extend(blocks_around(frame.point(x, y), voxel_m));
        }
        keys.sort_unstable();
        keys.dedup();
        keys
    };
    (0..height).into_par_iter().flat_map_iter(row).collect()
}
