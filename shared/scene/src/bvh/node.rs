//! The parts of a hierarchy: nodes of four boxes, and leaves of four triangles.

use glam::Vec4;

/// Number of triangles in a leaf, and of boxes in a node.
pub(super) const WIDTH: usize = 4;
/// Bit of a child's index that marks a leaf.
pub(super) const LEAF: u32 = 1 << 31;

/// Four 3D vectors, one `Vec4` per coordinate.
pub(super) type Lanes = [Vec4; 3];

/// Four boxes and their children. A child is the index of a node, or of a leaf if the bit [`LEAF`]
/// is set. Unused boxes are inverted (minimum above maximum), so that no ray enters them.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(super) struct Node {
    /// Minimum and maximum corners of the four boxes.
    pub(super) bounds: [Lanes; 2],
    pub(super) children: [u32; WIDTH],
}

impl Node {
    pub(super) const EMPTY: Self = Self { bounds: [[Vec4::MAX; 3], [Vec4::MIN; 3]], children: [LEAF; WIDTH] };
}

/// Four triangles in the layout of the intersection test: the first corner of each, and the edges
/// from it to the second and third. Unused triangles are degenerate, so that no ray hits them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Leaf {
    pub(super) corner: Lanes,
    pub(super) edges: [Lanes; 2],
    pub(super) triangles: [u32; WIDTH],
}

impl Leaf {
    pub(super) const EMPTY: Self =
        Self { corner: [Vec4::ZERO; 3], edges: [[Vec4::ZERO; 3]; 2], triangles: [0; WIDTH] };
}

/// The nodes and leaves of a hierarchy; node 0 is the root.
#[derive(Debug)]
pub(super) struct Tree {
    pub(super) nodes: Vec<Node>,
    pub(super) leaves: Vec<Leaf>,
}
