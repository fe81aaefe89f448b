//! From bytes to the most blocks that the volume may have, before anything is allocated.

use cosurf_scene::Camera;

use super::extract::LAYOUT_BYTES;
use super::frame::Texel;
use super::volume::STORED_BLOCK_BYTES;

/// Bytes that a block takes: in the volume, and while triangles are made of it.
pub(super) const BLOCK_BYTES: u64 = STORED_BLOCK_BYTES + LAYOUT_BYTES as u64;
/// Bytes kept for the mesh, per block: one in which the surface lies has about 80 vertices of 75 bytes
/// with their triangles, and every second or third is such a one. Where a wild surface has more, the
/// fusion is done again with larger voxels.
const MESH_BYTES_PER_BLOCK: u64 = 2_500;
/// Bytes per block while blocks are searched: a set of keys, grown by doubling.
const SEARCH_BYTES_PER_BLOCK: u64 = 40;
/// Bytes per pixel beside its texel: keys of eight blocks for one of four pixels, twice while they are
/// gathered.
const SEARCH_BYTES_PER_PIXEL: u64 = 32;
/// No volume is smaller: with so few blocks voxels are as large as houses.
const BLOCKS_LEAST: u64 = 64;

/// What fits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct VolumeBudget {
    /// Most blocks.
    pub(super) blocks_max: usize,
    /// Bytes for blocks and mesh together.
    pub(super) volume_bytes: u64,
}

impl VolumeBudget {
    /// Divides the bytes.
    pub(super) fn new(memory_bytes: u64, cameras: &[Camera]) -> Self {
        let volume_bytes = memory_bytes.saturating_sub(frame_bytes(cameras));
        let per_block = BLOCK_BYTES + MESH_BYTES_PER_BLOCK + SEARCH_BYTES_PER_BLOCK;
        let blocks_max = (volume_bytes / per_block).max(BLOCKS_LEAST);
        Self { blocks_max: blocks_max as usize, volume_bytes: blocks_max * per_block }
    }
}

/// Bytes that the view in work takes.
pub(super) fn frame_bytes(cameras: &[Camera]) -> u64 {
    let pixels = |camera: &Camera| u64::from(camera.size_px[0]) * u64::from(camera.size_px[1]);
    cameras.iter().map(pixels).max().unwrap_or(0) * (size_of::<Texel>() as u64 + SEARCH_BYTES_PER_PIXEL)
}

/// The least with which [`super::fuse()`] keeps its promise.
pub(super) fn least_bytes(cameras: &[Camera]) -> u64 {
    let per_block = BLOCK_BYTES + MESH_BYTES_PER_BLOCK + SEARCH_BYTES_PER_BLOCK;
    frame_bytes(cameras) + BLOCKS_LEAST * per_block
}
