//! Sites of many devices, made of one mission that is repeated at offsets: the models of its agents, with their cameras, on
//! a square grid of districts.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use cosurf_link::Model;
use cosurf_scene::{Camera, LocalFrame, Pose, ply};
use cosurf_tests::models::read_model;
use glam::DVec3;

/// What a site is made of.
#[derive(clap::Args)]
pub(crate) struct Districts {
    /// Output folders of a mission's agents
    #[arg(required = true)]
    agents: Vec<PathBuf>,
    /// Distance between two districts, world units [default: the width of the mission's cameras, 1.5 times]
    #[arg(long, value_name = "UNITS")]
    pitch: Option<f64>,
    /// Axis of the world that is vertical: 0, 1 or 2
    #[arg(long, value_name = "AXIS", default_value_t = 2)]
    vertical: usize,
}

impl Districts {
    /// Writes the models of the first `devices` devices to folders in `folder`.
    pub(crate) fn write(&self, folder: &Path, devices: usize) -> Result<Site> {
        let models = self.agents.iter().map(|agent| read_model(agent)).collect::<Result<Vec<_>>>()?;
        let pitch = self.pitch.unwrap_or_else(|| 1.5 * width(&models, self.vertical));
        Site::write(folder, &models, devices, pitch, self.vertical)
    }
}

/// Width of the box around all cameras, along the longer horizontal axis.
fn width(models: &[Model], vertical: usize) -> f64 {
    let cameras = || models.iter().flat_map(|model| &model.cameras);
    let places = || cameras().map(|camera| camera.cam_from_world.center());
    let low = places().fold(DVec3::INFINITY, DVec3::min);
    let size = places().fold(DVec3::NEG_INFINITY, DVec3::max) - low;
    size[(vertical + 1) % 3].max(size[(vertical + 2) % 3])
}

/// A site of many devices.
pub(crate) struct Site {
    /// The folders of the devices.
    pub(crate) folders: Vec<PathBuf>,
    /// The folder for what is merged.
    pub(crate) out: PathBuf,
    /// Number of splats of all models.
    pub(crate) splats: usize,
    /// Number of cameras of all models.
    pub(crate) cameras: usize,
}

impl Site {
    /// Writes the models of the first `devices` devices on a square grid of districts.
    fn write(folder: &Path, models: &[Model], devices: usize, pitch: f64, vertical: usize) -> Result<Self> {
        let across = (devices.div_ceil(models.len()) as f64).sqrt().ceil() as usize;
        let mut site = Self { folders: Vec::new(), out: folder.join("out"), splats: 0, cameras: 0 };
        for device in 0..devices {
            let (district, model) = (device / models.len(), &models[device % models.len()]);
            let mut offset = DVec3::ZERO;
            offset[(vertical + 1) % 3] = pitch * (district % across) as f64;
            offset[(vertical + 2) % 3] = pitch * (district / across) as f64;
            let its = folder.join(format!("device-{device:04}"));
            write(&its, &moved(model, offset)).with_context(|| its.display().to_string())?;
            site.splats += model.splats.len();
            site.cameras += model.cameras.len();
            site.folders.push(its);
        }
        Ok(site)
    }
}

fn write(folder: &Path, model: &Model) -> Result<()> {
    fs::create_dir_all(folder)?;
    ply::write(&folder.join("model.ply"), &model.splats, &LocalFrame::WORLD)?;
    fs::write(folder.join("cameras.json"), serde_json::to_string(&model.cameras)?)?;
    Ok(())
}

/// A model and its cameras, moved.
fn moved(model: &Model, by: DVec3) -> Model {
    let mut moved = model.clone();
    for mean in &mut moved.splats.means {
        *mean = (DVec3::from(mean.map(f64::from)) + by).as_vec3().to_array();
    }
    moved.cameras.iter_mut().for_each(|camera: &mut Camera| {
        let Pose { rotation, translation } = camera.cam_from_world;
        camera.cam_from_world = Pose { rotation, translation: translation - rotation * by };
    });
    moved
}
