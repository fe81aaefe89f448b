//! The synthetic town: a dataset with exact geometry that needs no download.
//!
//! What it is: [`City::build`] makes a small town from [`CitySettings`], as one triangle mesh with procedural
//! materials, and a drone's flight over it. Pictures, depth, normals, cameras, the sparse cloud and the true surface
//! all come from that mesh, so they agree exactly. World frame: x east, y north, z up, metres, the middle of the flown
//! square at the origin.
//!
//! What it refuses to know: splats, training, links, clocks. Random numbers come from integer hashes, and no function
//! of the platform's mathematics library is used, so the same settings give the same bytes on every machine.
//!
//! Where to start reading: [`City`], then `world.rs`, which builds the town, and `render.rs`, which draws it.
//!
//! ```
//! use cosurf_city::{City, CitySettings};
//!
//! let settings = CitySettings { extent_m: 10.0, views: 3, size_px: [32, 24], ..CitySettings::default() };
//! let city = City::build(&settings)?;
//! let frame = city.render(&city.cameras()[0]);
//! assert_eq!(frame.picture.size_px, [32, 24]);
//! assert!(frame.depth.iter().all(|depth_m| *depth_m >= 0.0));
//! // `city.write(folder, progress)` writes pictures, poses, cloud and truth as a COLMAP dataset.
//! # Ok::<(), cosurf_city::CityError>(())
//! ```

mod blocks;
mod building;
mod facade;
mod flight;
mod ground;
mod light;
mod material;
mod mesh;
mod noise;
mod palette;
mod paving;
mod plan;
mod props;
mod random;
mod render;
mod roadside;
mod roof;
mod roofing;
mod settings;
mod sight;
mod sparse;
mod street;
mod terrain;
#[cfg(test)]
mod tests;
mod tree;
mod truth;
mod world;
mod write;

pub use render::CityFrame;
pub use settings::{CityError, CitySettings};
pub use truth::TruthPoint;

use std::path::Path;

use cosurf_scene::{Camera, Dataset, Mesh, SceneError, View};

use flight::FlightPath;
use render::World;

/// A town and the flight over it.
#[derive(Debug)]
pub struct City {
    settings: CitySettings,
    world: World,
    cameras: Vec<Camera>,
}

impl City {
    /// Builds the town. Nothing is rendered yet.
    pub fn build(settings: &CitySettings) -> Result<Self, CityError> {
        settings.check()?;
        let flight = FlightPath::new(settings);
        let (flown_half_m, reach_m) = (0.5 * settings.extent_m, flight.reach_m());
        let world = World::build(settings.seed, flown_half_m as f32, reach_m as f32, flight.pixel_m() as f32);
        Ok(Self { settings: *settings, world, cameras: flight.cameras() })
    }

    /// The settings that the city was built from.
    pub fn settings(&self) -> &CitySettings {
        &self.settings
    }

    /// The cameras in the order of flight.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// Number of triangles of the town.
    pub fn triangle_count(&self) -> usize {
        self.world.mesh.triangles.len()
    }

    /// The views and the sparse cloud. The paths of the views are relative; no picture is written. The
    /// cloud has points on surfaces that at least three cameras see, with noise and a few outliers, as
    /// a reconstruction would find them.
    pub fn dataset(&self) -> Dataset {
        let digits = self.cameras.len().saturating_sub(1).to_string().len().max(4);
        let view = |(i, camera): (usize, &Camera)| {
            let name = format!("{i:0digits$}.jpg");
            View { path: Path::new(write::PICTURES).join(&name), name, camera: *camera }
        };
        Dataset {
            views: self.cameras.iter().enumerate().map(view).collect(),
            points: sparse::cloud(&self.world, &self.cameras, self.settings.seed),
        }
    }

    /// The part of the true surface that at least three cameras see, in small triangles.
    pub fn truth_mesh(&self) -> Mesh {
        truth::mesh(&self.world, &self.cameras)
    }

    /// `count` points spread evenly over the surface that at least three cameras see; fewer if there is
    /// hardly any such surface.
    pub fn truth_points(&self, count: usize, seed: u64) -> Vec<TruthPoint> {
        truth::points(&self.world, &self.cameras, count, seed)
    }

    /// Renders all pictures and writes them with poses, cloud and truth into `folder`, which is
    /// created: `images/*.jpg`, `sparse/0/*.bin`, `gt/mesh.ply`, `gt/points.ply`. Calls `progress` with
    /// the number of pictures done and their total. Returns the dataset with the paths written to.
    pub fn write(&self, folder: &Path, progress: impl FnMut(usize, usize)) -> Result<Dataset, SceneError> {
        write::write(self, folder, progress)
    }

    /// Renders the view of any camera, not only of those of the flight.
    pub fn render(&self, camera: &Camera) -> CityFrame {
        self.world.render(camera)
    }
}
