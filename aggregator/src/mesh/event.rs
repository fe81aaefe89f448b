//! The events of a fusion.

/// What a fusion reports.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FuseEvent {
    /// Progress of a stage.
    Progress {
        /// The stage.
        stage: Stage,
        /// Views done.
        done: usize,
        /// Views in all.
        of: usize,
    },
    /// The memory is too small for these voxels; the fusion starts over with larger ones.
    Coarser {
        /// Edge of a voxel as wanted, world units.
        wanted_m: f64,
        /// Edge of a voxel in the next attempt, world units.
        voxel_m: f64,
    },
}

/// The stages of a fusion that go through all views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Measures how far away the surface is.
    Look,
    /// Finds the blocks that the surface passes through.
    Find,
    /// Fuses signed distances.
    Fuse,
}
