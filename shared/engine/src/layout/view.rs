//! The parameters of a camera for the passes: f32, with all values that are the same for all splats.

use cosurf_scene::Camera;
use glam::DMat3;

use super::tiles::TileImage;

/// Distance outside the picture, as a share of its size, up to which the projection of a splat is linearised at its
/// centre; beyond, it is linearised at this limit (3DGS: 1.3 tan(fov/2), which is 15 %).
const LINEARISATION_MARGIN: f64 = 0.15;

#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewParams {
    /// `cam_from_world` rotation, row by row.
    pub(crate) rotation: [[f32; 3]; 3],
    pub(crate) translation: [f32; 3],
    /// Camera centre in the world.
    pub(crate) eye: [f32; 3],
    pub(crate) focal_px: [f32; 2],
    pub(crate) center_px: [f32; 2],
    pub(crate) size_px: [u32; 2],
    /// Limits of `x / z` and `y / z` inside the Jacobian.
    pub(crate) slope_min: [f32; 2],
    pub(crate) slope_max: [f32; 2],
    /// SH degree in use, at most the stored one.
    pub(crate) sh_degree: u32,
}

impl ViewParams {
    pub(crate) fn new(camera: &Camera, sh_degree: u32) -> Self {
        let rotation = DMat3::from_quat(camera.cam_from_world.rotation.normalize());
        let size = camera.size_px.map(f64::from);
        let (focal, center) = (camera.focal_px.to_array(), camera.center_px.to_array());
        let slope = |axis: usize, edge: f64| (((edge * size[axis]) - center[axis]) / focal[axis]) as f32;
        Self {
            rotation: [0, 1, 2].map(|r| rotation.row(r).to_array().map(|v| v as f32)),
            translation: camera.cam_from_world.translation.to_array().map(|v| v as f32),
            eye: camera.cam_from_world.center().to_array().map(|v| v as f32),
            focal_px: focal.map(|v| v as f32),
            center_px: center.map(|v| v as f32),
            size_px: camera.size_px,
            slope_min: [0, 1].map(|axis| slope(axis, -LINEARISATION_MARGIN)),
            slope_max: [0, 1].map(|axis| slope(axis, 1.0 + LINEARISATION_MARGIN)),
            sh_degree,
        }
    }

    /// Tiles across and down.
    pub(crate) fn tiles(&self) -> [usize; 2] {
        TileImage::tiles_of(self.size_px)
    }
}

/// The transform `neighbour_from_here` between two views.
pub(crate) struct RelativePose {
    pub(crate) rotation: [[f32; 3]; 3],
    pub(crate) translation: [f32; 3],
}

impl RelativePose {
    pub(crate) fn new(here: &ViewParams, there: &ViewParams) -> Self {
        let wide = |rows: [[f32; 3]; 3]| rows.map(|row| row.map(f64::from));
        let (h, t) = (wide(here.rotation), wide(there.rotation));
        let rotation: [[f64; 3]; 3] =
            std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|k| t[r][k] * h[c][k]).sum()));
        // From the difference of the centres: far from the origin, translations would cancel and lose precision.
        let way: [f64; 3] = std::array::from_fn(|k| f64::from(here.eye[k]) - f64::from(there.eye[k]));
        let translation: [f64; 3] = std::array::from_fn(|r| (0..3).map(|k| t[r][k] * way[k]).sum());
        Self {
            rotation: rotation.map(|row| row.map(|v| v as f32)),
            translation: translation.map(|v| v as f32),
        }
    }
}
