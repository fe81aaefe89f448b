//! Turns the memory limit into a limit on the volume's blocks, before anything is allocated.

use cosurf_scene::Camera;

use super::extract::LAYOUT_BYTES;
use super::frame::Texel;
use super::volume::STORED_BLOCK_BYTES;

/// Bytes that a block takes in the volume and in the extraction of triangles.
pub(super) const BLOCK_BYTES: u64 = STORED_BLOCK_BYTES + LAYOUT_BYTES as u64;
/// Part of the memory that remains for the blocks that are fused at the same time, if there are as many blocks as possible.
/// With less, more views would be rendered several times.
const PART_SHARE: u64 = 4;
/// Bytes reserved for the mesh per block. A block on the surface has about 80 vertices and twice as many
/// triangles, and every second or third block is on the surface. If the mesh of a rough surface takes more,
/// the fusion starts over with larger voxels.
const MESH_BYTES_PER_BLOCK: u64 = 2_500;
/// Bytes per block while blocks are searched for: the hash set of their keys, which doubles its capacity when
/// it is full.
const SEARCH_BYTES_PER_BLOCK: u64 = 40;
/// Bytes that a block takes beside those in the volume: its key, and the triangles in it.
const MESHED_BLOCK_BYTES: u64 = MESH_BYTES_PER_BLOCK + SEARCH_BYTES_PER_BLOCK;
/// Bytes per block while specks are looked for in a mesh that is not in memory: every second or third block has about 80
/// vertices, of [`super::clean::Pieces::VERTEX_BYTES`] each.
const PIECES_BYTES_PER_BLOCK: u64 = 320;
/// Bytes per pixel, beside its [`Texel`], while blocks are searched for. With voxels as large as pixels, the
/// search renders at half the width and height, so it has a quarter of the pixels. Each pixel gives the keys
/// of up to eight blocks, which are held twice while they are gathered.
const SEARCH_BYTES_PER_PIXEL: u64 = 32;
/// Least number of blocks. With fewer blocks, voxels would be larger than houses, and the mesh useless.
const BLOCKS_LEAST: u64 = 64;

/// Bytes of memory that a mesh takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct MeshBytes {
    /// The most per block of the whole mesh, with the block's key.
    most: u64,
    /// Per block of the whole mesh, while blocks are fused.
    beside: u64,
    /// Per block of those that are fused at the same time.
    own: u64,
}

impl MeshBytes {
    /// Of a mesh that is in memory as a whole.
    pub(super) const IN_MEMORY: Self = Self { most: MESHED_BLOCK_BYTES, beside: MESHED_BLOCK_BYTES, own: 0 };
    /// Of a mesh of which only the part that is being made is in memory.
    pub(super) const IN_FILES: Self = Self {
        most: SEARCH_BYTES_PER_BLOCK + PIECES_BYTES_PER_BLOCK,
        beside: SEARCH_BYTES_PER_BLOCK,
        own: MESH_BYTES_PER_BLOCK,
    };
}

/// Limits that follow from the memory limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct VolumeBudget {
    /// Limit on the number of blocks.
    pub(super) blocks_max: usize,
    /// Bytes for the blocks that are fused at the same time and the mesh together.
    pub(super) volume_bytes: u64,
    mesh: MeshBytes,
}

impl VolumeBudget {
    /// Divides the memory between the view being fused and the volume.
    pub(super) fn new(memory_bytes: u64, cameras: &[Camera], mesh: MeshBytes) -> Self {
        let volume_bytes = memory_bytes.saturating_sub(frame_bytes(cameras));
        let volume_bytes = volume_bytes.max(BLOCKS_LEAST * (BLOCK_BYTES + MESHED_BLOCK_BYTES));
        let blocks_max = (volume_bytes - volume_bytes / PART_SHARE) / mesh.most;
        Self { blocks_max: blocks_max as usize, volume_bytes, mesh }
    }

    /// Number of blocks that may be fused at the same time if there are `blocks` in all.
    pub(super) fn part_max(&self, blocks: usize) -> usize {
        let left = self.volume_bytes.saturating_sub(blocks as u64 * self.mesh.beside);
        (left / (BLOCK_BYTES + self.mesh.own)) as usize
    }
}

/// Largest number of bytes that the view being fused takes.
pub(super) fn frame_bytes(cameras: &[Camera]) -> u64 {
    let pixels = |camera: &Camera| u64::from(camera.size_px[0]) * u64::from(camera.size_px[1]);
    cameras.iter().map(pixels).max().unwrap_or(0) * (size_of::<Texel>() as u64 + SEARCH_BYTES_PER_PIXEL)
}

/// The smallest memory limit that [`super::fuse()`] can keep, bytes.
pub(super) fn least_bytes(cameras: &[Camera]) -> u64 {
    frame_bytes(cameras) + BLOCKS_LEAST * (BLOCK_BYTES + MESHED_BLOCK_BYTES)
}
