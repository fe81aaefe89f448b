//! Turns the memory limit into a limit on the volume's blocks, before anything is allocated.

use cosurf_scene::Camera;

use super::extract::LAYOUT_BYTES;
use super::frame::Texel;
use super::volume::STORED_BLOCK_BYTES;

/// Bytes that a block takes: in the volume, and while triangles are made of it.
pub(super) const BLOCK_BYTES: u64 = STORED_BLOCK_BYTES + LAYOUT_BYTES as u64;
/// Bytes reserved for the mesh per block. A block on the surface has about 80 vertices of 75 bytes, with
/// their triangles, and every second or third block is on the surface. If a rough surface has more, the
/// fusion starts over with larger voxels.
const MESH_BYTES_PER_BLOCK: u64 = 2_500;
/// Bytes per block while blocks are searched: a set of keys that grows by doubling.
const SEARCH_BYTES_PER_BLOCK: u64 = 40;
/// Bytes per pixel beside its texel: keys of eight blocks for every fourth pixel, twice while they are
/// gathered.
const SEARCH_BYTES_PER_PIXEL: u64 = 32;
/// Least number of blocks: with fewer, voxels would be larger than houses.
const BLOCKS_LEAST: u64 = 64;

/// What fits into the memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct VolumeBudget {
    /// Limit on blocks.
    pub(super) blocks_max: usize,
    /// Bytes for blocks and mesh together.
    pub(super) volume_bytes: u64,
}

impl VolumeBudget {
    /// Divides the memory between the view being fused and the volume.
    pub(super) fn new(memory_bytes: u64, cameras: &[Camera]) -> Self {
        let volume_bytes = memory_bytes.saturating_sub(frame_bytes(cameras));
        let per_block = BLOCK_BYTES + MESH_BYTES_PER_BLOCK + SEARCH_BYTES_PER_BLOCK;
        let blocks_max = (volume_bytes / per_block).max(BLOCKS_LEAST);
        Self { blocks_max: blocks_max as usize, volume_bytes: blocks_max * per_block }
    }
}

/// Bytes of the view being fused, at most.
pub(super) fn frame_bytes(cameras: &[Camera]) -> u64 {
    let pixels = |camera: &Camera| u64::from(camera.size_px[0]) * u64::from(camera.size_px[1]);
    cameras.iter().map(pixels).max().unwrap_or(0) * (size_of::<Texel>() as u64 + SEARCH_BYTES_PER_PIXEL)
}

/// The least memory with which [`super::fuse()`] keeps its limit, bytes.
pub(super) fn least_bytes(cameras: &[Camera]) -> u64 {
    let per_block = BLOCK_BYTES + MESH_BYTES_PER_BLOCK + SEARCH_BYTES_PER_BLOCK;
    frame_bytes(cameras) + BLOCKS_LEAST * per_block
}
