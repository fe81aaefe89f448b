//! Lenses that are told for a film instead of for a picture, as RealityCapture does.

use std::path::Path;

use glam::DVec2;

use crate::Picture;
use crate::error::Refusal;
use crate::lens::{Distortion, FullBrown, Lens};

/// The longer side of the film, millimetres.
const FILM_MM: f64 = 36.0;
/// What to do about a lens that is not supported.
const REMEDY: &str = "set the distortion model to one of Brown's in RealityCapture and align again, or export undistorted photographs";

/// A lens for a film of 36 mm along the longer side of the picture.
pub(crate) struct FilmLens {
    /// Focal length, millimetres.
    pub(crate) focal_mm: f64,
    /// Principal point from the middle of the picture, as a share of its longer side, x right and y down.
    pub(crate) center_share: DVec2,
    /// k1, k2, k3, k4, t1, t2.
    pub(crate) distortion: [f64; 6],
}

impl FilmLens {
    /// The lens for the size of a picture on disk.
    pub(crate) fn on(&self, picture: &Path) -> Result<Lens, Refusal> {
        let size_px = Picture::size_of(picture).map_err(|error| Refusal::from(error.to_string()))?;
        let side_px = f64::from(size_px[0].max(size_px[1]));
        let middle = 0.5 * DVec2::from(size_px.map(f64::from));
        let lens = Lens {
            focal_px: DVec2::splat(self.focal_mm / FILM_MM * side_px),
            center_px: middle + self.center_share * side_px,
            size_px,
            distortion: distortion(self.distortion),
        };
        lens.checked()
    }

    /// The refusal of a lens of another kind.
    pub(crate) fn unsupported(what: &str) -> Refusal {
        format!("{what} of its lens is not supported; {REMEDY}").into()
    }
}

/// *Brown4* has k1 to k4, factors of r² to r⁸. The tangential coefficients have the other order than OpenCV's: RealityScan
/// 2.2 writes k1, k2, t2, t1, k3, k4 "in OpenCV ordering" (`calibration.xml`, *OpenCV-compliant Internal/External Camera
/// Parameters*), which is k1, k2, p1, p2, k3. AliceVision and camorph read them in this way, too.
fn distortion([k1, k2, k3, k4, t1, t2]: [f64; 6]) -> Distortion {
    Distortion::brown(FullBrown { radial: [k1, k2, k3, k4], tangential: [t2, t1], ..FullBrown::default() })
}
