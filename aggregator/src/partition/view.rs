//! A view of the dataset with the cell that it belongs to.

use cosurf_scene::Footprint;

/// A view of the dataset, with the ground that it sees and its cell.
#[derive(Clone, Debug)]
pub(crate) struct AssignedView {
    /// Name of the view.
    pub(crate) name: String,
    /// The ground that the view sees.
    pub(crate) footprint: Footprint,
    /// Index of the cell that the view belongs to.
    pub(crate) cell: usize,
    /// Whether the view is held out.
    pub(crate) held_out: bool,
}
