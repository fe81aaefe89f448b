//! What a fusion tells while it works.

/// What a fusion is about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FuseEvent {
    /// A stage has done with some of its views.
    Progress {
        /// What is being done.
        stage: Stage,
        /// Views done.
        done: usize,
        /// Views in all.
        of: usize,
    },
    /// The memory does not suffice for voxels of the size wanted.
    Coarser {
        /// Edge of a voxel as it was to be, world units.
        wanted_m: f64,
        /// As it will be.
        voxel_m: f64,
    },
}

/// The stages of a fusion that go through all views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// How far away the surface is.
    Look,
    /// Which blocks it passes through.
    Find,
    /// Signed distances.
    Fuse,
}
