//! Lenses with distortion, as the exports of other tools have them.
//!
//! What it knows nothing about: files.

mod brown;
mod straight;

use glam::DVec2;

use crate::error::Refusal;
use crate::{Camera, Pose};
pub use brown::FullBrown;

/// Largest accepted width or height of a picture, pixels.
const SIDE_PX_MAX: u32 = 1 << 20;

/// The intrinsics of a camera whose lens may bend straight lines.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Focal lengths in x and y, pixels, finite and positive.
    pub focal_px: DVec2,
    /// Principal point in pixels, measured from the picture's top-left corner.
    pub center_px: DVec2,
    /// Width and height in pixels, each at least 1.
    pub size_px: [u32; 2],
    /// How the lens bends.
    pub distortion: Distortion,
}

/// How a lens bends the direction (x, y) on the plane at distance 1. Coefficients are those of OpenCV, without a unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// The model of Brown and Conrady, COLMAP's `FULL_OPENCV` with k4 = k5 = k6 = 0.
    Brown {
        /// k1, k2, k3: factors of r², r⁴ and r⁶.
        radial: [f64; 3],
        /// p1, p2.
        tangential: [f64; 2],
    },
    /// The same with terms that no model of COLMAP has; one of them is not 0.
    FullBrown(FullBrown),
    /// COLMAP's `OPENCV_FISHEYE`: k1 to k4, factors of powers of the angle from the optical axis.
    Fisheye([f64; 4]),
}

impl Distortion {
    /// That of a pinhole.
    pub(crate) const NONE: Self = Self::Brown { radial: [0.0; 3], tangential: [0.0; 2] };

    /// As COLMAP's model if that has all the terms.
    pub(crate) fn brown(full: FullBrown) -> Self {
        let FullBrown { radial: [k1, k2, k3, k4], tangential, growth, skew } = full;
        match (k4, growth, skew) == (0.0, [0.0; 2], 0.0) {
            true => Self::Brown { radial: [k1, k2, k3], tangential },
            false => Self::FullBrown(full),
        }
    }

    fn is_finite(&self) -> bool {
        match self {
            Self::FullBrown(full) => full.is_finite(),
            Self::Brown { radial, tangential } => radial.iter().chain(tangential).all(|k| k.is_finite()),
            Self::Fisheye(k) => k.iter().all(|k| k.is_finite()),
        }
    }
}

impl Lens {
    /// The same lens, or a refusal if a number cannot be one of a lens.
    pub(crate) fn checked(self) -> Result<Self, Refusal> {
        let Self { focal_px, center_px, size_px, distortion } = self;
        if size_px.iter().any(|side| !(1..=SIDE_PX_MAX).contains(side)) {
            return Err(format!("the picture size {} × {} pixels is invalid", size_px[0], size_px[1]).into());
        }
        if !(focal_px.min_element() > 0.0 && focal_px.is_finite() && center_px.is_finite()) {
            return Err(format!("the focal length {focal_px} px or centre {center_px} px is invalid").into());
        }
        match distortion.is_finite() {
            true => Ok(self),
            false => Err("a coefficient of its distortion is not finite".into()),
        }
    }

    /// Whether the lens bends, so that its pictures are not those of a pinhole.
    pub(crate) fn is_distorted(&self) -> bool {
        self.distortion != Distortion::NONE
    }

    /// Whether COLMAP has a model of the lens, so that it can undistort its pictures.
    pub fn is_known_to_colmap(&self) -> bool {
        !matches!(self.distortion, Distortion::FullBrown(_))
    }

    /// The pinhole camera with these focal lengths.
    pub(crate) fn pinhole(&self, cam_from_world: Pose) -> Camera {
        let Self { focal_px, center_px, size_px, .. } = *self;
        Camera { cam_from_world, focal_px, center_px, size_px }
    }
}
