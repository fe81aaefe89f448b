//! Why there is no mesh.

/// Why there is no mesh.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// Nothing to look with.
    #[error("there are no cameras to look at the model with")]
    NoCameras,
    /// No view shows anything.
    #[error(
        "no view shows a surface: the model is empty, or these cameras look elsewhere; use the cameras that it was trained with"
    )]
    NoSurface,
    /// What the views show does not agree.
    #[error(
        "the views agree on no surface: all that was found are specks; use more views, or larger voxels (--voxel)"
    )]
    NoAgreement,
    /// Not even the renderer fits.
    #[error("the model with {splats} splats needs {} of memory to be rendered, but may take {}; allow more memory (--memory)", cosurf_scene::bytes::format_bytes(*needed_bytes), cosurf_scene::bytes::format_bytes(*memory_bytes))]
    TooLittleMemory {
        /// In the model.
        splats: usize,
        /// The least that would do.
        needed_bytes: u64,
        /// What was given.
        memory_bytes: u64,
    },
}
