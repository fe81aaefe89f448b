//! One scene in other coordinates: elsewhere in the world, turned, or in another unit.

use std::fs;
use std::path::Path;

use anyhow::Result;
use cosurf_scene::{Camera, Dataset, Mesh, Pose, colmap};
use glam::{DMat3, DQuat, DVec3};

/// Radius of the earth, metres.
const EARTH_M: f64 = 6_371_000.0;
/// A place in the middle of Europe, in UTM.
pub const UTM: DVec3 = DVec3::new(500_000.0, 5_200_000.0, 400.0);

/// Other coordinates for a scene: `scale · rotation p + translation`.
#[derive(Clone, Copy)]
pub struct Coordinates {
    /// Positive.
    pub scale: f64,
    /// Unit length.
    pub rotation: DQuat,
    /// World units.
    pub translation: DVec3,
}

impl Coordinates {
    /// Those that the scene has.
    pub const OWN: Self = Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// The scene moved.
    pub fn at(translation: DVec3) -> Self {
        Self { translation, ..Self::OWN }
    }

    /// The scene scaled.
    pub fn times(scale: f64) -> Self {
        Self { scale, ..Self::OWN }
    }

    /// A scene with x to the east, y to the north and z up, in the earth's frame (ECEF), in Switzerland.
    pub fn ecef() -> Self {
        let (latitude, longitude) = (46.9_f64.to_radians(), 7.4_f64.to_radians());
        let up =
            DVec3::new(latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin());
        let east = DVec3::new(-longitude.sin(), longitude.cos(), 0.0);
        let axes = DMat3::from_cols(east, up.cross(east), up);
        Self { rotation: DQuat::from_mat3(&axes), ..Self::at(EARTH_M * up) }
    }

    /// Maps a point of the scene.
    pub fn point(&self, p: DVec3) -> DVec3 {
        self.scale * (self.rotation * p) + self.translation
    }

    /// Maps a camera of the scene.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let center = self.point(camera.cam_from_world.center());
        let rotation = (camera.cam_from_world.rotation * self.rotation.inverse()).normalize();
        Camera { cam_from_world: Pose { rotation, translation: -(rotation * center) }, ..*camera }
    }

    /// Writes a dataset in these coordinates; the pictures are linked.
    pub fn write(&self, data: &Path, folder: &Path) -> Result<()> {
        let mut dataset = Dataset::open(data)?;
        dataset.views.iter_mut().for_each(|view| view.camera = self.camera(&view.camera));
        dataset.points.iter_mut().for_each(|point| point.position = self.point(point.position));
        fs::create_dir_all(folder)?;
        std::os::unix::fs::symlink(fs::canonicalize(data)?.join("images"), folder.join("images"))?;
        colmap::write(folder, &dataset)?;
        Ok(())
    }

    /// Maps a mesh back to the scene's own coordinates.
    pub fn mesh_back(&self, mut mesh: Mesh) -> Mesh {
        let origin = std::mem::take(&mut mesh.origin);
        let back = |p: [f32; 3]| {
            let world = origin + DVec3::from_array(p.map(f64::from));
            let own = self.rotation.inverse() * (world - self.translation) / self.scale;
            own.as_vec3().to_array()
        };
        mesh.positions.iter_mut().for_each(|p| *p = back(*p));
        mesh
    }
}
