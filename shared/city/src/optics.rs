//! How a camera of a real drone differs from an ideal one: its lens distorts, and it chooses an exposure for each picture.

use glam::DVec2;

use cosurf_scene::Camera;

/// Rounds in which a distorted position is turned back. After 12, the distortions here are undone to a millionth of a pixel.
const ROUNDS: usize = 12;

/// Lens and exposure of a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Optics {
    pub(super) lens: Lens,
    /// Factor on the light of the picture.
    pub(super) gain: f32,
}

impl Optics {
    /// No distortion, and the exposure of all pictures of the built-in mission.
    pub(super) const IDEAL: Self = Self { lens: Lens { radial: [0.0; 2] }, gain: 1.0 };
}

/// A lens with the radial distortion of OpenCV's and COLMAP's models: a position at distance `r` from the axis, at depth 1,
/// moves outwards by the factor `1 + k1 r² + k2 r⁴`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lens {
    /// `[k1, k2]`
    pub(super) radial: [f64; 2],
}

impl Lens {
    fn factor(&self, r2: f64) -> f64 {
        1.0 + r2 * (self.radial[0] + r2 * self.radial[1])
    }

    /// Where the picture shows what an ideal lens would show at `p_px`.
    pub(super) fn distorted(&self, camera: &Camera, p_px: DVec2) -> DVec2 {
        let at = (p_px - camera.center_px) / camera.focal_px;
        camera.center_px + camera.focal_px * at * self.factor(at.length_squared())
    }

    /// Where an ideal lens would show what the picture shows at `p_px`.
    pub(super) fn undistorted(&self, camera: &Camera, p_px: DVec2) -> DVec2 {
        if self.radial == [0.0; 2] {
            return p_px;
        }
        let seen = (p_px - camera.center_px) / camera.focal_px;
        let ideal = (0..ROUNDS).fold(seen, |at, _| seen / self.factor(at.length_squared()));
        camera.center_px + camera.focal_px * ideal
    }
}

#[cfg(test)]
mod tests {
    use cosurf_scene::Pose;
    use glam::DVec3;

    use super::*;

    #[test]
    fn distortion_is_undone() {
        let camera = Camera {
            cam_from_world: Pose::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(520.0),
            center_px: DVec2::new(310.0, 250.0),
            size_px: [640, 480],
        };
        let lens = Lens { radial: [-0.11, 0.02] };
        for p_px in [DVec2::ZERO, DVec2::new(640.0, 480.0), DVec2::new(310.5, 240.0)] {
            let back = lens.distorted(&camera, lens.undistorted(&camera, p_px));
            assert!(back.distance(p_px) < 1e-6, "{p_px} {back}");
        }
        let corner = lens.distorted(&camera, DVec2::ZERO);
        assert!(corner.x > 10.0 && corner.y > 8.0, "a barrel draws corners inwards: {corner}");
        assert_eq!(Optics::IDEAL.lens.undistorted(&camera, DVec2::new(0.1, 0.7)), DVec2::new(0.1, 0.7));
    }
}
