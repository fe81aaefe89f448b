//! Lenses with distortion, as the exports of other tools have them.
//!
//! What it knows nothing about: files, and how a picture is undistorted.

use glam::DVec2;

use crate::error::Refusal;
use crate::{Camera, Pose};

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
    /// COLMAP's `OPENCV_FISHEYE`: k1 to k4, factors of powers of the angle from the optical axis.
    Fisheye([f64; 4]),
}

impl Distortion {
    /// That of a pinhole.
    pub(crate) const NONE: Self = Self::Brown { radial: [0.0; 3], tangential: [0.0; 2] };

    fn is_finite(&self) -> bool {
        match self {
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

    /// The pinhole camera with these focal lengths.
    pub(crate) fn pinhole(&self, cam_from_world: Pose) -> Camera {
        let Self { focal_px, center_px, size_px, .. } = *self;
        Camera { cam_from_world, focal_px, center_px, size_px }
    }
}
