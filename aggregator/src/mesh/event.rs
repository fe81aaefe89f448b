//! The events of a fusion.

/// What a fusion reports.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FuseEvent {
    /// Progress of a stage.
    Progress {
        /// The stage.
        stage: Stage,
        /// Number of views done; for [`Stage::Write`], of parts of the mesh.
        done: usize,
        /// Number of views in all, or of parts.
        of: usize,
    },
    /// The memory is too small for voxels of the current size. The fusion starts over with larger voxels.
    Coarser {
        /// Wanted edge length of a voxel, world units.
        wanted_m: f64,
        /// Edge length of a voxel in the next attempt, world units.
        voxel_m: f64,
    },
}

/// The stages of a fusion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Measures how far away the surface is.
    Look,
    /// Finds the blocks that the surface passes through.
    Find,
    /// Fuses signed distances.
    Fuse,
    /// Writes a mesh that is not in memory.
    Write,
}
