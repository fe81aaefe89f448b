//! What a surveyor delivers of a model: heights and a true orthophoto as maps, points, contours, volumes, and a statement
//! of how accurate they are.
//!
//! A mesh is fused from renderings of all cameras ([`crate::mesh`]): it has no floaters, so heights and points come from
//! it. The colours of the map come from the splats, rendered straight down. Both are computed tile by tile into files
//! without names, from which the deliverables are then written.
//!
//! What it knows nothing about: how the model was made, geoids, command lines. The world of the model must be ENU metres
//! about the origin of a site ([`cosurf_geo`]).
//!
//! Where to start reading: [`survey`], the list of steps. The modules, each below those that use it:
//!
//! ```text
//! survey ─► accuracy, cog, points, contours, volumes     one file each
//!            └─ heights, terrain, colors                 the surface, the ground and the splats, seen from above
//!                └─ lattice, tiles, grid ─► place        pixels of the map; values of pixels; where on the earth
//! ```

mod accuracy;
mod cog;
mod colors;
mod contours;
mod error;
mod grid;
mod heights;
mod lattice;
mod place;
mod points;
mod scene;
mod terrain;
#[cfg(test)]
mod tests;
mod tiles;
mod volumes;
mod witnesses;

use std::fs;
use std::path::PathBuf;

use cosurf_geo::Georeference;
use cosurf_scene::{SceneError, atomic};

use crate::mesh::FuseEvent;
use crate::service::remove;
pub use accuracy::{Accuracy, MadeFile, PointsAccuracy};
use accuracy::{Made, accuracy_of};
use contours::{ContourOrder, write_contours};
pub use error::SurveyError;
use heights::{Surface, find_heights};
use lattice::Lattice;
use place::Place;
use points::write_points;
use scene::Scene;
use terrain::find_terrain;
use tiles::Tiles;
pub use volumes::Volume;
use volumes::{find_volumes, read_polygons};
use witnesses::Witnesses;

/// What to make.
#[derive(Clone, Debug)]
pub struct SurveyOrder {
    /// Folder of the model: `global.ply` or `model.ply`, and `cameras.json`.
    pub folder: PathBuf,
    /// Folder of the deliverables.
    pub out: PathBuf,
    /// Where on the earth the model lies.
    pub georeference: Georeference,
    /// Side of a pixel in the coordinate system, metres, above 0; `None` for the median length that a pixel of the
    /// cameras covers on the surface, rounded to two digits.
    pub gsd_m: Option<f64>,
    /// Difference of height between two contours, metres, above 0.
    pub contours_m: f64,
    /// GeoJSON file of the polygons whose volumes are wanted.
    pub volumes: Option<PathBuf>,
    /// Limit on the memory of the process, bytes.
    pub memory_bytes: u64,
    /// Number of threads, at least 1.
    pub threads: usize,
}

/// What a survey reports.
#[derive(Clone, Copy, Debug)]
pub enum SurveyEvent {
    /// Progress of the mesh.
    Fusion(FuseEvent),
    /// Progress of a stage that goes through the tiles of the map.
    Tiles {
        /// Name of the stage.
        stage: &'static str,
        /// Number of tiles done.
        done: usize,
        /// Number of tiles in all.
        of: usize,
    },
}

/// Makes all files: `dsm.tif`, `dtm.tif`, `ortho.tif`, `points.laz`, `contours.geojson`, `volumes.json` if polygons are
/// given, and last `accuracy.json`, so that its presence tells that the others are complete.
pub fn survey(order: &SurveyOrder, mut on_event: impl FnMut(SurveyEvent)) -> Result<Accuracy, SurveyError> {
    let place = Place::new(&order.georeference)?;
    // Read before the mesh is made, so that a wrong file is reported at once.
    let polygons = order.volumes.as_deref().map(|file| read_polygons(file, &place)).transpose()?;
    let scene = Scene::open(&order.folder, order.memory_bytes)?;
    fs::create_dir_all(&order.out).map_err(|cause| SceneError::io(&order.out, cause))?;
    atomic::remove_partial_files(&order.out)?;
    let at = |name| order.out.join(name);
    let accuracy_file = at("accuracy.json");
    remove(&accuracy_file)?; // its statement is of the files of an earlier run

    let fused =
        scene.mesh(order.memory_bytes, order.threads, |event| on_event(SurveyEvent::Fusion(event)))?;
    let witnesses = Witnesses::of(&scene.cameras);
    let surface = Surface::of(&fused.mesh, &scene.frame, &scene.cameras, &witnesses)?;
    let gsd_m = order.gsd_m.unwrap_or(surface.gsd_m);
    let lattice = Lattice::around(place, &surface.seen, gsd_m)?;
    let points = write_points(&at("points.laz"), &fused.mesh, &surface, lattice.place(), &scene.frame)?;
    let voxel_m = fused.voxel_m;
    drop(fused);

    let mut heights = Tiles::new(&order.out, lattice.size_px(), lattice::TILE_PX)?;
    let mut show = |stage, done, of| on_event(SurveyEvent::Tiles { stage, done, of });
    let covered = find_heights(&surface, &witnesses, &lattice, &mut heights, |d, n| show("heights", d, n))?;
    if covered.pixels == 0 {
        return Err(SurveyError::NothingSeen);
    }
    cog::write_heights(&at("dsm.tif"), &lattice, &mut heights)?;
    let mut terrain = Tiles::new(&order.out, lattice.size_px(), lattice::TILE_PX)?;
    let range_m = find_terrain(&mut heights, gsd_m, &mut terrain, order.memory_bytes)?;
    cog::write_heights(&at("dtm.tif"), &lattice, &mut terrain)?;
    let contours = ContourOrder { step_m: order.contours_m, range_m, memory_bytes: order.memory_bytes };
    write_contours(&at("contours.geojson"), &lattice, &mut terrain, &contours)?;
    drop(terrain);
    let volumes = match &polygons {
        Some(polygons) => Some(find_volumes(polygons, &lattice, &mut heights)?),
        None => None,
    };
    if let Some(volumes) = &volumes {
        atomic::write_bytes(&at("volumes.json"), volumes::to_json(volumes).as_bytes())?;
    }

    let kept = scene.splats_of(&surface, voxel_m)?;
    drop(surface);
    let mut colors = Tiles::new(&order.out, lattice.size_px(), lattice::TILE_PX)?;
    let mut painter = colors::Painter::new(&kept.splats, scene.frame, order.threads);
    let splats_left_out = kept.left_out;
    drop(kept);
    painter.paint(&lattice, &mut heights, &mut colors, |d, n| show("colours", d, n))?;
    cog::write_colors(&at("ortho.tif"), &lattice, &mut colors)?;

    let made = Made { covered, points, voxel_m, cameras: scene.cameras.len(), splats_left_out };
    let accuracy = accuracy_of(&order.georeference, &lattice, &made, order.contours_m, volumes.is_some());
    atomic::write_bytes(&accuracy_file, accuracy.to_json().as_bytes())?;
    Ok(accuracy)
}
