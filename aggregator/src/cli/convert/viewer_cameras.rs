//! Writes cameras in the format of `cameras.json` of 3DGS, which viewers open beside a model (`camera_to_JSON` in
//! `utils/camera_utils.py` of graphdeco-inria/gaussian-splatting).

use std::path::Path;

use cosurf_scene::{Camera, Pose, SceneError, atomic};
use glam::{DMat3, DQuat};
use serde::Serialize;

/// A camera. Its principal point is taken to be in the middle: the format has no other.
#[derive(Serialize)]
struct ViewerCamera {
    id: usize,
    img_name: String,
    width: u32,
    height: u32,
    position: [f64; 3],
    /// Rows of the rotation from the camera to the world.
    rotation: [[f64; 3]; 3],
    fy: f64,
    fx: f64,
}

/// Writes cameras, turned about the origin, atomically.
pub(super) fn write(path: &Path, cameras: &[Camera], rotation: DQuat) -> Result<(), SceneError> {
    let list: Vec<ViewerCamera> =
        cameras.iter().enumerate().map(|(id, camera)| of(id, camera, rotation)).collect();
    let json = serde_json::to_vec_pretty(&list).map_err(|error| SceneError::io(path, error.into()))?;
    atomic::write_bytes(path, &json)
}

fn of(id: usize, camera: &Camera, rotation: DQuat) -> ViewerCamera {
    let Camera { cam_from_world: Pose { rotation: cam_from_world, .. }, focal_px, size_px, .. } = *camera;
    let world_from_cam = DMat3::from_quat(rotation * cam_from_world.inverse());
    ViewerCamera {
        id,
        img_name: format!("camera-{:04}", id + 1),
        width: size_px[0],
        height: size_px[1],
        position: (rotation * camera.cam_from_world.center()).to_array(),
        rotation: world_from_cam.transpose().to_cols_array_2d(),
        fy: focal_px.y,
        fx: focal_px.x,
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};

    use super::*;

    #[test]
    fn positions_and_rotations_are_those_of_3dgs() {
        let camera = Camera {
            cam_from_world: Pose::look_at(DVec3::new(1.0, 2.0, 30.0), DVec3::new(1.0, 12.0, 0.0), DVec3::Z),
            focal_px: DVec2::new(500.0, 510.0),
            center_px: DVec2::new(320.0, 240.0),
            size_px: [640, 480],
        };
        let its = of(0, &camera, DQuat::IDENTITY);
        assert!((DVec3::from(its.position) - DVec3::new(1.0, 2.0, 30.0)).length() < 1e-9);
        // The third column is the direction in which the camera looks.
        let forward = DVec3::from(its.rotation.map(|row| row[2]));
        assert!((forward - DVec3::new(0.0, 10.0, -30.0).normalize()).length() < 1e-9, "{forward}");
        let turned = of(0, &camera, DQuat::from_rotation_z(std::f64::consts::PI));
        assert!((DVec3::from(turned.position) - DVec3::new(-1.0, -2.0, 30.0)).length() < 1e-9);
        assert_eq!((its.fx, its.fy, its.img_name.as_str()), (500.0, 510.0, "camera-0001"));
    }
}
