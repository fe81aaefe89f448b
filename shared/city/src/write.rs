//! Writes the city as a dataset, in the layout of real scenes.

use std::path::Path;

use cosurf_scene::{Dataset, Mesh, SceneError, colmap, files};

use super::city::{City, PICTURES};
use super::truth::TruthPoint;

/// Folder of the truth.
pub(super) const TRUTH: &str = "gt";
/// JPEG quality of the pictures.
const QUALITY: u8 = 95;
/// Truth points per square metre of the flown square.
const POINTS_PER_M2: f64 = 2.0;
/// Least and greatest number of truth points.
const POINTS_RANGE: (f64, f64) = (20_000.0, 400_000.0);

impl City {
    /// Renders all pictures and writes them with poses, cloud and truth into `folder`, which is
    /// created: `images/*.jpg`, `sparse/0/*.bin`, `gt/mesh.ply`, `gt/points.ply`, `gt/ground.ply`. Calls `progress` with
    /// the number of pictures done and their total. Returns the dataset with the paths written to.
    pub fn write(
        &self,
        folder: &Path,
        mut progress: impl FnMut(usize, usize),
    ) -> Result<Dataset, SceneError> {
        for name in [PICTURES, TRUTH] {
            let folder = folder.join(name);
            files::create_folder(&folder)?;
        }
        let mut dataset = self.dataset();
        let total = dataset.views.len();
        for (i, view) in dataset.views.iter_mut().enumerate() {
            view.path = folder.join(&view.path);
            self.render(&view.camera).picture.write_jpeg(&view.path, QUALITY)?;
            progress(i + 1, total);
        }
        colmap::write(folder, &dataset)?;
        write_truth(self, &folder.join(TRUTH))?;
        Ok(dataset)
    }
}

/// Writes the true surface of a city as a mesh and as points, and its terrain.
pub(super) fn write_truth(city: &City, folder: &Path) -> Result<(), SceneError> {
    city.truth_mesh().write_ply(&folder.join("mesh.ply"))?;
    city.ground_mesh().write_ply(&folder.join("ground.ply"))?;
    let area = city.settings().extent_m * city.settings().extent_m;
    let count = (POINTS_PER_M2 * area).clamp(POINTS_RANGE.0, POINTS_RANGE.1) as usize;
    let points = city.truth_points(count, city.settings().seed);
    cloud(&points).write_ply(&folder.join("points.ply"))
}

/// The points as a mesh without triangles.
fn cloud(points: &[TruthPoint]) -> Mesh {
    Mesh {
        positions: points.iter().map(|point| point.position).collect(),
        normals: points.iter().map(|point| point.normal).collect(),
        rgb: points.iter().map(|point| point.rgb).collect(),
        ..Mesh::default()
    }
}
