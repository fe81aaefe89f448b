//! Why there is no survey.

use cosurf_engine::ViewError;
use cosurf_geo::GeoError;
use cosurf_scene::SceneError;
use cosurf_scene::bytes::format_bytes;

use crate::mesh::MeshError;

/// Why there is no survey.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SurveyError {
    /// A file cannot be read or written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The georeference is wrong, or the coordinate system does not cover the site.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// No mesh can be made.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The memory is too small to write maps.
    #[error("a survey of this model needs {} MiB of memory, but the limit is {}; allow more memory (--memory)", needed_bytes.div_ceil(1 << 20), format_bytes(*memory_bytes))]
    TooLittleMemory {
        /// A memory limit that suffices, bytes.
        needed_bytes: u64,
        /// The memory limit, bytes.
        memory_bytes: u64,
    },
    /// The memory is too small to write a map of this size.
    #[error("a map of {} × {} px needs {} MiB of memory, but the limit is {}; allow more memory (--memory), or larger pixels (--gsd)", size_px[0], size_px[1], needed_bytes.div_ceil(1 << 20), format_bytes(*memory_bytes))]
    LittleForMap {
        /// Width and height, px.
        size_px: [u32; 2],
        /// A memory limit that suffices, bytes.
        needed_bytes: u64,
        /// The memory limit, bytes.
        memory_bytes: u64,
    },
    /// No three cameras show the same ground.
    #[error(
        "no three cameras show the same ground, so there is nothing to measure; use a model of pictures that overlap"
    )]
    NothingSeen,
    /// The map has too many pixels.
    #[error("pixels of {gsd_m} m make a map of {} × {} px, but {} px a side are the most; use --gsd {enough_m} or more", size_px[0], size_px[1], side_max_px)]
    TooLarge {
        /// Side of a pixel, metres.
        gsd_m: f64,
        /// Width and height, px.
        size_px: [u64; 2],
        /// Largest side, px.
        side_max_px: u64,
        /// A side of a pixel that suffices, metres.
        enough_m: f64,
    },
    /// A pixel would cover the whole surface.
    #[error("pixels of {gsd_m} m are larger than the surface, {:.1} m × {:.1} m; use a smaller --gsd", sides_m[0], sides_m[1])]
    TooCoarse {
        /// Side of a pixel, metres.
        gsd_m: f64,
        /// Width and height of the surface, metres.
        sides_m: [f64; 2],
    },
    /// There would be too many contours.
    #[error("contours every {step_m} m are too many for heights from {:.1} m to {:.1} m; use --contours {enough_m} or more", range_m[0], range_m[1])]
    TooManyContours {
        /// Difference of height between two contours, metres.
        step_m: f64,
        /// Lowest and highest height, metres.
        range_m: [f64; 2],
        /// A difference that suffices, metres.
        enough_m: f64,
    },
}

impl From<ViewError> for SurveyError {
    fn from(error: ViewError) -> Self {
        match error {
            ViewError::Scene(error) => Self::Scene(error),
            ViewError::TooLittleMemory { splats, needed_bytes, memory_bytes, .. } => {
                Self::Mesh(MeshError::TooLittleMemory { splats, needed_bytes, memory_bytes })
            }
            error => Self::Mesh(MeshError::View(error)),
        }
    }
}
