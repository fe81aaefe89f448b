//! The parameters of a camera as the passes use them: in f32, with derived values that are the same for all splats.

use cosurf_scene::Camera;
use glam::DMat3;

use super::tiles::TileImage;

/// The projection of a splat is linearised at the splat's centre. A centre further outside the picture than this share
/// of the picture's size is first moved to that distance. 3DGS uses the same limit: 1.3 tan(fov / 2) is 15 % of the
/// size beyond the edge.
const LINEARISATION_MARGIN: f64 = 0.15;

#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewParams {
    /// `cam_from_world` rotation, row by row.
    pub(crate) rotation: [[f32; 3]; 3],
    pub(crate) translation: [f32; 3],
    /// Camera centre in the world frame.
    pub(crate) eye: [f32; 3],
    pub(crate) focal_px: [f32; 2],
    pub(crate) center_px: [f32; 2],
    pub(crate) size_px: [u32; 2],
    /// Smallest `x / z` and `y / z` at which projections are linearised.
    pub(crate) slope_min: [f32; 2],
    /// Largest `x / z` and `y / z` at which projections are linearised.
    pub(crate) slope_max: [f32; 2],
    /// SH degree in use, at most the stored degree.
    pub(crate) sh_degree: u32,
    /// Largest depth of a splat's centre, world units; deeper ones are invisible.
    pub(crate) far: f32,
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
            far: f32::MAX,
        }
    }

    /// The view without what lies deeper than `far`, world units.
    pub(crate) fn up_to(self, far: f64) -> Self {
        Self { far: far.min(f64::from(f32::MAX)) as f32, ..self }
    }

    /// Number of tiles across and down.
    pub(crate) fn tiles(&self) -> [usize; 2] {
        TileImage::tiles_of(self.size_px)
    }
}

/// The transform `neighbour_from_here`, from the camera frame of one view to that of a neighbouring view.
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
        // Computed from the difference of the camera centres. Far from the origin the translations of both cameras are
        // large, and their difference would lose precision.
        let way: [f64; 3] = std::array::from_fn(|k| f64::from(here.eye[k]) - f64::from(there.eye[k]));
        let translation: [f64; 3] = std::array::from_fn(|r| (0..3).map(|k| t[r][k] * way[k]).sum());
        Self {
            rotation: rotation.map(|row| row.map(|v| v as f32)),
            translation: translation.map(|v| v as f32),
        }
    }
}
