//! How finely objects are built.

/// Number of triangles of an object: many near the flown square, few far from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Detail {
    Fine,
    Coarse,
}
