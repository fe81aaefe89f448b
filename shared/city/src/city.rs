//! The city with its cameras, which gives pictures, the sparse cloud and the true surface.

use std::path::Path;

use cosurf_scene::{Camera, Dataset, Mesh, View};

use super::flight::FlightPath;
use super::optics::Optics;
use super::render::{CityFrame, World};
use super::settings::{CityError, CitySettings};
use super::sparse;
use super::targets::Targets;
use super::truth::{self, TruthPoint};

/// Folder of the pictures, within that of the dataset.
pub(super) const PICTURES: &str = "images";

/// A city and the flight over it.
#[derive(Debug)]
pub struct City {
    settings: CitySettings,
    pub(super) world: World,
    cameras: Vec<Camera>,
}

impl City {
    /// Builds the city. Nothing is rendered yet.
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

    /// Number of triangles of the city.
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
            View { path: Path::new(PICTURES).join(&name), name, camera: *camera, mask: None }
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

    /// The true terrain: the bare ground and water, also below what stands on it. Triangles may have any orientation.
    pub fn ground_mesh(&self) -> Mesh {
        truth::ground(&self.world)
    }

    /// `count` points spread evenly over the surface that at least three cameras see; fewer if there is
    /// hardly any such surface.
    pub fn truth_points(&self, count: usize, seed: u64) -> Vec<TruthPoint> {
        truth::points(&self.world, &self.cameras, count, seed)
    }

    /// Renders the view of any camera, not only of those of the flight.
    pub fn render(&self, camera: &Camera) -> CityFrame {
        self.world.render(camera, &Optics::IDEAL, &Targets::default())
    }
}
