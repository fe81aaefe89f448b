//! Lenses that are told for a film instead of for a picture, as RealityCapture does.

use std::path::Path;

use glam::DVec2;

use crate::Picture;
use crate::error::Refusal;
use crate::lens::{Distortion, Lens};

/// The longer side of the film, millimetres.
const FILM_MM: f64 = 36.0;
/// What to do about a lens that is not supported.
const REMEDY: &str =
    "set the distortion model to Brown3 in RealityCapture and align again, or export undistorted photographs";

/// A lens for a film of 36 mm along the longer side of the picture.
pub(crate) struct FilmLens {
    /// Focal length, millimetres.
    pub(crate) focal_mm: f64,
    /// Principal point from the middle of the picture, millimetres, x right and y down.
    pub(crate) center_mm: DVec2,
    /// k1, k2, k3, k4, and the two tangential coefficients.
    pub(crate) distortion: [f64; 6],
}

impl FilmLens {
    /// The lens for the size of a picture on disk.
    pub(crate) fn on(&self, picture: &Path) -> Result<Lens, Refusal> {
        let [k1, k2, k3, rest @ ..] = self.distortion;
        if rest != [0.0; 3] {
            return Err(format!("its lens has a fourth radial or a tangential coefficient; {REMEDY}").into());
        }
        let size_px = Picture::size_of(picture).map_err(|error| Refusal::from(error.to_string()))?;
        let px_per_mm = f64::from(size_px[0].max(size_px[1])) / FILM_MM;
        let middle = 0.5 * DVec2::from(size_px.map(f64::from));
        let lens = Lens {
            focal_px: DVec2::splat(self.focal_mm * px_per_mm),
            center_px: middle + self.center_mm * px_per_mm,
            size_px,
            distortion: Distortion::Brown { radial: [k1, k2, k3], tangential: [0.0; 2] },
        };
        lens.checked()
    }

    /// The refusal of a lens of another kind.
    pub(crate) fn unsupported(what: &str) -> Refusal {
        format!("{what} of its lens is not supported; {REMEDY}").into()
    }
}
