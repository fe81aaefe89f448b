//! Marching cubes over the blocks, one volume after the other, each in two passes. The first pass counts vertices and
//! triangles, so that the mesh grows once. The second pass writes the triangles of each block into the block's own range of
//! the mesh. A triangle at the border of a volume has vertices in blocks of a later one; they are filled in then. So the mesh
//! has the same bytes for any division into volumes. What the mesh has so far may be moved out of the memory between two volumes.

use cosurf_scene::{Mesh, MeshCounts};
use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::cases::{EDGE_STARTS, cases};
use super::volume::{Key, SIDE, VOXELS, Volume, Voxel};

/// Number of samples along the edge of a block, including the first sample of the next block.
const WIDE: usize = SIDE + 1;
/// Bytes that extraction takes per block: the layout of the block, and its slices of the mesh.
pub(super) const LAYOUT_BYTES: usize = size_of::<BlockLayout>() + 4 * 24;
/// Bytes of a vertex: position, normal, colour, and work space for removing specks.
const VERTEX_BYTES: u64 = 12 + 12 + 3 + 9;
/// Bytes of a vertex that is moved out of the memory: position and colour.
const MOVED_VERTEX_BYTES: u64 = 12 + 3;
const TRIANGLE_BYTES: u64 = 12;

/// What a block adds to the mesh. A vertex lies on an edge of the voxel grid that the surface crosses.
#[derive(Clone, Copy, Debug, Default)]
struct BlockLayout {
    /// The crossed edges, as bits. Bit `8 * y + x` of word `[axis, z]` stands for the edge that starts at
    /// voxel `[x, y, z]` of the block and runs along `axis`.
    edges: [[u64; SIDE]; 3],
    /// Index of the block's first vertex in the mesh.
    first_vertex: u32,
    /// Index of the block's first triangle in the mesh.
    first_triangle: u32,
}

impl BlockLayout {
    fn vertices(&self) -> u32 {
        self.edges.as_flattened().iter().map(|bits| bits.count_ones()).sum()
    }

    /// Index, in the mesh, of the vertex on the edge that starts at a voxel and runs along `axis`.
    fn vertex(&self, [x, y, z]: [usize; 3], axis: usize) -> u32 {
        let word = axis * SIDE + z;
        let before: u32 = self.edges.as_flattened()[..word].iter().map(|bits| bits.count_ones()).sum();
        let below = self.edges[axis][z] & ((1 << (y * SIDE + x)) - 1);
        self.first_vertex + before + below.count_ones()
    }
}

/// The ranges of the mesh into which the blocks of a volume write.
#[derive(Debug)]
pub(super) struct Layout {
    /// The first blocks of the volume; those after them only border on them.
    blocks: Vec<BlockLayout>,
    /// Counts of the mesh without these blocks.
    before: MeshCounts,
    /// Counts of the mesh with these blocks.
    pub(super) after: MeshCounts,
}

impl Layout {
    /// Counts the vertices and triangles of the first `own` blocks, which follow those of a mesh with the counts `before`.
    pub(super) fn new(volume: &Volume, own: usize, before: MeshCounts) -> Self {
        let mut blocks = vec![BlockLayout::default(); own];
        let triangles: Vec<u32> = blocks
            .par_iter_mut()
            .zip(volume.keys())
            .map(|(block, key)| {
                let samples = Samples::gather(volume, key.block());
                block.edges = samples.edges();
                let mut triangles = 0;
                samples.for_each_cell(|_, case| triangles += cases()[case].triangles.len() as u32);
                triangles
            })
            .collect();
        let mut after = before;
        for (block, triangles) in blocks.iter_mut().zip(&triangles) {
            // These casts may overflow, but `fits_indices` refuses such a large mesh before the indices are
            // used.
            (block.first_vertex, block.first_triangle) = (after.vertices as u32, after.triangles as u32);
            after.vertices += u64::from(block.vertices());
            after.triangles += u64::from(*triangles);
        }
        Self { blocks, before, after }
    }

    /// Index, in the mesh, of a vertex that an earlier volume asked for; `None` if its block is not among these.
    fn vertex_of(&self, volume: &Volume, block: &Key, edge: [u8; 4]) -> Option<u32> {
        let block = self.blocks.get(volume.find(block.block())?)?;
        let [x, y, z, axis] = edge.map(usize::from);
        Some(block.vertex([x, y, z], axis))
    }

    /// Bytes of the layout, and of the mesh with these blocks, if all of it stays in memory.
    pub(super) fn bytes(&self) -> u64 {
        let MeshCounts { vertices, triangles } = self.after;
        self.own_bytes() + vertices * VERTEX_BYTES + triangles * TRIANGLE_BYTES
    }

    /// Bytes of the layout, and of what these blocks add to the mesh, if the rest was moved out of the memory.
    pub(super) fn moved_bytes(&self) -> u64 {
        let more = self.more();
        self.own_bytes() + more.vertices * MOVED_VERTEX_BYTES + more.triangles * TRIANGLE_BYTES
    }

    fn own_bytes(&self) -> u64 {
        (self.blocks.len() * LAYOUT_BYTES) as u64
    }

    /// Counts of what these blocks add to the mesh.
    fn more(&self) -> MeshCounts {
        MeshCounts {
            vertices: self.after.vertices - self.before.vertices,
            triangles: self.after.triangles - self.before.triangles,
        }
    }

    /// Whether 32-bit indices suffice for all vertices and triangles.
    pub(super) fn fits_indices(&self) -> bool {
        self.after.vertices.max(self.after.triangles) < u64::from(u32::MAX)
    }
}

/// A mesh that grows volume by volume, without normals. Some vertices may belong to no triangle.
#[derive(Debug, Default)]
pub(super) struct Extraction {
    /// What was not moved out of the memory. Its triangles name vertices by their indices in the whole mesh.
    mesh: Mesh,
    /// Counts of what was moved out of the memory.
    moved: MeshCounts,
    pending: Vec<Pending>,
    /// Vertices that triangles need which were moved out of the memory before.
    late: Vec<LateCorner>,
}

/// A vertex of a triangle that was moved out of the memory before the vertex had an index.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct LateCorner {
    /// Index of the triangle in the mesh.
    pub(super) triangle: u32,
    /// Index of the corner, 0..3.
    pub(super) corner: u8,
    /// Index of the vertex in the mesh.
    pub(super) vertex: u32,
}

/// A corner of a triangle whose vertex belongs to a block of a later volume.
#[derive(Debug)]
struct Pending {
    /// The vertex's block.
    block: Key,
    /// The vertex's edge: the voxel `[x, y, z]` of the block at which it starts, and its axis.
    edge: [u8; 4],
    /// Index of the triangle in the mesh.
    triangle: u32,
    /// Index of the corner, 0..3.
    corner: u8,
}

impl Extraction {
    /// Bytes of the notes about vertices of later volumes.
    pub(super) fn pending_bytes(&self) -> u64 {
        (self.pending.capacity() * size_of::<Pending>() + self.late.capacity() * size_of::<LateCorner>())
            as u64
    }

    /// Counts of the whole mesh so far.
    pub(super) fn counts(&self) -> MeshCounts {
        let MeshCounts { vertices, triangles } = self.mesh.counts();
        MeshCounts { vertices: self.moved.vertices + vertices, triangles: self.moved.triangles + triangles }
    }

    /// Returns what is in memory and forgets it, and vertices for triangles that were returned before.
    pub(super) fn move_out(&mut self) -> (Mesh, Vec<LateCorner>) {
        self.moved = self.counts();
        (std::mem::take(&mut self.mesh), std::mem::take(&mut self.late))
    }

    /// Adds the blocks of a volume that `layout` has counted. They must follow those of all volumes before.
    pub(super) fn add(&mut self, volume: &Volume, layout: &Layout) {
        let Self { mesh, moved, pending, late } = self;
        let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
        let more = layout.more();
        grow(&mut mesh.positions, more.vertices as usize);
        grow(&mut mesh.rgb, more.vertices as usize);
        grow(&mut mesh.triangles, more.triangles as usize);
        pending.retain(|&Pending { triangle, corner, ref block, edge }| {
            let vertex = layout.vertex_of(volume, block, edge);
            if let Some(vertex) = vertex {
                match u64::from(triangle).checked_sub(moved.triangles) {
                    Some(place) => mesh.triangles[place as usize][usize::from(corner)] = vertex,
                    None => late.push(LateCorner { triangle, corner, vertex }),
                }
            }
            vertex.is_none()
        });
        let firsts = |of: fn(&BlockLayout) -> u32, before: u64| {
            layout.blocks.iter().map(move |block| (u64::from(of(block)) - before) as usize)
        };
        let first_vertex = |block: &BlockLayout| block.first_vertex;
        let positions = split(&mut mesh.positions[vertices..], firsts(first_vertex, layout.before.vertices));
        let rgb = split(&mut mesh.rgb[vertices..], firsts(first_vertex, layout.before.vertices));
        let first_triangle = |block: &BlockLayout| block.first_triangle;
        let own = split(&mut mesh.triangles[triangles..], firsts(first_triangle, layout.before.triangles));
        let outputs: Vec<_> = positions.into_iter().zip(rgb).zip(own).collect();
        let later =
            volume.keys().par_iter().zip(&layout.blocks).zip(outputs).flat_map_iter(|((key, block), out)| {
                if out.0.0.is_empty() && out.1.is_empty() {
                    return Vec::new();
                }
                let samples = Samples::gather(volume, key.block());
                write_vertices(volume, &samples, block, out.0.0, out.0.1);
                write_triangles(&samples, layout, block.first_triangle, out.1)
            });
        pending.par_extend(later);
    }
}

/// Appends zeros, without room for more.
fn grow<const N: usize, T: Copy + Default>(list: &mut Vec<[T; N]>, more: usize) {
    list.reserve_exact(more);
    list.resize(list.len() + more, [T::default(); N]);
}

/// Splits a slice into parts that start at `firsts`. The first start must be 0.
fn split<T>(mut slice: &mut [T], firsts: impl Iterator<Item = usize>) -> Vec<&mut [T]> {
    let mut parts = Vec::new();
    let mut begin = 0;
    for first in firsts.skip(1) {
        let (part, rest) = slice.split_at_mut(first - begin);
        parts.push(part);
        (slice, begin) = (rest, first);
    }
    parts.push(slice);
    parts
}

fn write_vertices(
    volume: &Volume,
    samples: &Samples,
    block: &BlockLayout,
    positions: &mut [[f32; 3]],
    rgb: &mut [[u8; 3]],
) {
    let origin = volume.origin(samples.block);
    let mut out = positions.iter_mut().zip(rgb);
    for axis in 0..3 {
        for z in 0..SIDE {
            let mut bits = block.edges[axis][z];
            while bits != 0 {
                let place = bits.trailing_zeros() as usize;
                bits &= bits - 1;
                let from = [place % SIDE, place / SIDE, z];
                let mut to = from;
                to[axis] += 1;
                let (a, b) = (samples.at(from), samples.at(to));
                let t = a.distance / (a.distance - b.distance);
                let mut at = DVec3::from_array(from.map(|v| v as f64));
                at[axis] += f64::from(t);
                if let Some((position, color)) = out.next() {
                    *position = (origin + at * volume.voxel_m).as_vec3().to_array();
                    *color = mix_colors(a, b, t);
                }
            }
        }
    }
}

/// The colour at a point between two voxels; `t` is 0 at `a` and 1 at `b`. A voxel counts more if it is
/// nearer or its colour has a larger weight.
fn mix_colors(a: &Voxel, b: &Voxel, t: f32) -> [u8; 3] {
    let ((a, a_weight), (b, b_weight)) = (a.color(), b.color());
    let (a_share, b_share) = ((1.0 - t) * a_weight, t * b_weight);
    let whole = (a_share + b_share).max(f32::MIN_POSITIVE);
    [0, 1, 2].map(|c| ((a[c] * a_share + b[c] * b_share) / whole + 0.5) as u8)
}

/// Writes the triangles of a block, of which `first` is the index of the first. Returns the corners that belong to blocks of
/// later volumes.
fn write_triangles(samples: &Samples, layout: &Layout, first: u32, out: &mut [[u32; 3]]) -> Vec<Pending> {
    let mut later = Vec::new();
    let mut out = (first..).zip(out);
    samples.for_each_cell(|cell, case| {
        for edges in &cases()[case].triangles {
            let Some((triangle, out)) = out.next() else { return };
            for ((corner, edge), vertex) in (0..).zip(edges).zip(out) {
                let axis = usize::from(*edge) / 4;
                let voxel = corner_of(cell, EDGE_STARTS[usize::from(*edge)]);
                // `for_each_cell` visits only cells whose corners are all measured, so the block of every corner
                // exists.
                let Some(owner) = samples.blocks[owner_of(voxel)] else { continue };
                let [x, y, z] = voxel.map(|v| v % SIDE);
                match layout.blocks.get(owner) {
                    Some(block) => *vertex = block.vertex([x, y, z], axis),
                    None => {
                        let (block, edge) = (samples.volume.keys()[owner], [x, y, z, axis].map(|v| v as u8));
                        later.push(Pending { block, edge, triangle, corner });
                    }
                }
            }
        }
    });
    later
}

fn corner_of([x, y, z]: [usize; 3], corner: usize) -> [usize; 3] {
    [x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2)]
}

/// The block to which a voxel at `[x, y, z]`, 0..=8, belongs: 0 for the block itself, else one of its seven
/// upper neighbours (towards +x, +y or +z). The blocks are numbered like the corners of a cell.
fn owner_of([x, y, z]: [usize; 3]) -> usize {
    x / SIDE + 2 * (y / SIDE) + 4 * (z / SIDE)
}

/// The voxels that the cells of a block need: those of the block itself, and the first layers of its upper
/// neighbours (towards +x, +y and +z).
struct Samples<'a> {
    volume: &'a Volume,
    block: IVec3,
    /// Indices of the block itself and of its upper neighbours, numbered like corners; `None` for a missing
    /// block.
    blocks: [Option<usize>; 8],
}

impl<'a> Samples<'a> {
    fn gather(volume: &'a Volume, block: IVec3) -> Self {
        let neighbour = |corner: usize| {
            let [x, y, z] = corner_of([0; 3], corner).map(|v| v as i32);
            volume.find(block + IVec3::new(x, y, z))
        };
        Self { volume, block, blocks: std::array::from_fn(neighbour) }
    }

    /// The voxel at `place`, 0..=8 along each axis. If its block does not exist, a voxel with weight 0.
    fn at(&self, place: [usize; 3]) -> &Voxel {
        const UNKNOWN: Voxel = Voxel::UNKNOWN;
        let [x, y, z] = place.map(|v| v % SIDE);
        match self.blocks[owner_of(place)] {
            Some(index) => &self.volume.block(index)[(z * SIDE + y) * SIDE + x],
            None => &UNKNOWN,
        }
    }

    /// Signed distances of the 9³ samples, `[z, y, x]`; NaN where no view has measured.
    fn distances(&self) -> [f32; WIDE * WIDE * WIDE] {
        std::array::from_fn(|i| {
            let voxel = self.at([i % WIDE, i / WIDE % WIDE, i / (WIDE * WIDE)]);
            if voxel.weight > 0.0 { voxel.distance } else { f32::NAN }
        })
    }

    /// The edges that the surface crosses, as in [`BlockLayout`].
    fn edges(&self) -> [[u64; SIDE]; 3] {
        let distances = self.distances();
        let mut edges = [[0; SIDE]; 3];
        for i in 0..VOXELS {
            let [x, y, z] = [i % SIDE, i / SIDE % SIDE, i / (SIDE * SIDE)];
            let at = (z * WIDE + y) * WIDE + x;
            for (axis, step) in [1, WIDE, WIDE * WIDE].into_iter().enumerate() {
                let (a, b) = (distances[at], distances[at + step]);
                if (a < 0.0 && b >= 0.0) || (a >= 0.0 && b < 0.0) {
                    edges[axis][z] |= 1 << (y * SIDE + x);
                }
            }
        }
        edges
    }

    /// Calls `visit` with every cell of the block whose corners are all measured and differ in sign, and with
    /// the index of the cell's case in [`cases()`].
    fn for_each_cell(&self, mut visit: impl FnMut([usize; 3], usize)) {
        let distances = self.distances();
        for i in 0..VOXELS {
            let cell = [i % SIDE, i / SIDE % SIDE, i / (SIDE * SIDE)];
            let (mut case, mut known) = (0, true);
            for corner in 0..8 {
                let [x, y, z] = corner_of(cell, corner);
                let distance = distances[(z * WIDE + y) * WIDE + x];
                known &= !distance.is_nan();
                case |= usize::from(distance < 0.0) << corner;
            }
            if known && case != 0 && case != 255 {
                visit(cell, case);
            }
        }
    }
}
