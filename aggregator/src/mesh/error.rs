//! Why there is no mesh.

use cosurf_engine::ViewError;
use cosurf_scene::SceneError;

/// Why there is no mesh.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// There are no cameras.
    #[error("there are no cameras to render the model; use those that it was trained with")]
    NoCameras,
    /// No view shows a surface.
    #[error(
        "no view shows a surface: the model is empty, or these cameras look elsewhere; use the cameras that it was trained with"
    )]
    NoSurface,
    /// The views do not agree on a surface.
    #[error(
        "the views agree on no surface, only on small pieces; use more views, or larger voxels (--voxel)"
    )]
    NoAgreement,
    /// The model cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A picture cannot be rendered.
    #[error(transparent)]
    View(ViewError),
    /// The caller has stopped the fusion.
    #[error("the mesh was not made: the program was asked to end")]
    Stopped,
    /// The memory is too small to render the model.
    #[error("rendering {splats} splats needs {} MiB of memory, but the limit is {}; allow more memory (--memory)", needed_bytes.div_ceil(1 << 20), cosurf_scene::bytes::format_bytes(*memory_bytes))]
    TooLittleMemory {
        /// Number of splats of the model.
        splats: usize,
        /// A memory limit that suffices, bytes.
        needed_bytes: u64,
        /// The memory limit, bytes.
        memory_bytes: u64,
    },
}
