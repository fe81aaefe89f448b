//! COLMAP's reconstructions before undistortion: which photographs have poses, the lenses, and the points that tie the
//! photographs together. Read in COLMAP's text form, written in the binary one, which keeps names with spaces.

mod read;
mod write;

use cosurf_geo::Similarity;
use cosurf_scene::Pose;
use glam::{DVec2, DVec3};

use super::lens::Lens;

/// A photograph with its pose.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Posed {
    pub(super) name: String,
    pub(super) cam_from_world: Pose,
    /// Index of its lens.
    pub(super) lens: usize,
}

/// A point that photographs show.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TiePoint {
    pub(super) position: DVec3,
    pub(super) rgb: [u8; 3],
}

/// Where a photograph shows a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TieMark {
    /// Index of the point.
    pub(super) point: u32,
    /// Index of the photograph.
    pub(super) photograph: u32,
    /// In the stored picture.
    pub(super) at_px: DVec2,
}

/// A reconstruction.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Reconstruction {
    /// In the order of their names.
    pub(super) posed: Vec<Posed>,
    pub(super) lenses: Vec<Lens>,
    pub(super) points: Vec<TiePoint>,
    /// In the order of points, and of photographs within a point.
    pub(super) marks: Vec<TieMark>,
}

impl Reconstruction {
    /// The line of sight through a pixel of the stored photograph: the camera's position and a direction of unit length,
    /// and the focal length, pixels. `None` if the lens does not see there.
    pub(super) fn sight(&self, posed: &Posed, at_px: DVec2) -> Option<(DVec3, DVec3, f64)> {
        let lens = &self.lenses[posed.lens];
        let ray = lens.ray(at_px)?.extend(1.0).normalize();
        let pose = &posed.cam_from_world;
        Some((pose.center(), pose.rotation.inverse() * ray, lens.focal_px.x))
    }

    /// Moves cameras and points to another frame; the pictures show the same.
    pub(super) fn move_by(&mut self, similarity: &Similarity) {
        for posed in &mut self.posed {
            let Pose { rotation, translation } = posed.cam_from_world;
            let rotation = (rotation * similarity.rotation.inverse()).normalize();
            let translation = similarity.scale * translation - rotation * similarity.translation;
            posed.cam_from_world = Pose { rotation, translation };
        }
        self.points.iter_mut().for_each(|point| point.position = similarity.apply(point.position));
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Camera;
    use glam::DQuat;

    use super::*;

    #[test]
    fn pictures_show_the_same_after_the_move() {
        let pose = Pose {
            rotation: DQuat::from_xyzw(0.1, 0.2, -0.3, 0.9).normalize(),
            translation: DVec3::new(0.1, 0.2, 3.0),
        };
        let mut its = Reconstruction {
            posed: vec![Posed { name: "a.jpg".into(), cam_from_world: pose, lens: 0 }],
            lenses: Vec::new(),
            points: vec![TiePoint { position: DVec3::new(0.3, -0.1, 1.0), rgb: [0; 3] }],
            marks: Vec::new(),
        };
        let seen = |its: &Reconstruction| {
            let camera = Camera {
                cam_from_world: its.posed[0].cam_from_world,
                focal_px: DVec2::splat(500.0),
                center_px: DVec2::new(320.0, 240.0),
                size_px: [640, 480],
            };
            camera.project_with_depth(its.points[0].position).unwrap()
        };
        let before = seen(&its);
        its.move_by(&Similarity {
            scale: 11.0,
            rotation: DQuat::from_rotation_x(2.0),
            translation: DVec3::new(5.0, 6.0, 7.0),
        });
        let after = seen(&its);
        assert!(after.0.distance(before.0) < 1e-9);
        assert!((after.1 - 11.0 * before.1).abs() < 1e-9);
    }
}
