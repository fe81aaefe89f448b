//! A view of the dataset with the cell that it was given to.

use super::footprint::Footprint;

/// A view of the dataset, with the ground that it sees and its cell.
#[derive(Clone, Debug)]
pub(crate) struct AssignedView {
    /// Name of the view.
    pub(crate) name: String,
    /// The ground that it sees.
    pub(crate) footprint: Footprint,
    /// Index of its cell.
    pub(crate) cell: usize,
    /// Whether it is held out.
    pub(crate) held_out: bool,
}
