//! What a surveyor delivers of a model: heights and a true orthophoto as maps, points, a mesh, contours, volumes, and a
//! statement of how accurate they are.
//!
//! A mesh is fused from renderings of all cameras ([`crate::mesh`]): it has few floaters, so heights and points come from
//! it. Heights that do not agree with what the cameras show are left out. The colours of the map come from the splats,
//! rendered straight down. The cameras are rendered once for all comparisons. All is computed tile by tile into files
//! without names, from which the deliverables are then written.
//!
//! The memory is that of the fusion. The cameras are rendered again beside the mesh, in the memory that it leaves: the
//! fusion counts more for each of its vertices, so pictures have the same size. The splats of the map's colours are in a file,
//! and read for as many tiles as there is memory for. The picture of the mesh takes what the mesh leaves, with fewer pixels or
//! not at all if that is little. All that follows works on a few tiles at a time ([`writing_bytes`]).
//!
//! What it knows nothing about: how the model was made, command lines. The world of the model must be ENU metres
//! about the origin of a site ([`cosurf_geo`]).
//!
//! Where to start reading: [`survey`], the list of steps. The modules, each below those that use it:
//!
//! ```text
//! survey ─► accuracy, cog, points, solid, contours, volumes   the files
//!            └─ splat_tiles, splat_claims                     those with splats
//!            └─ confidence, floaters ─► views, depths        how wrong heights may be; what floats; what cameras show
//!            └─ heights, terrain, splats, colors              the surface, the ground, what nobody sees of them
//!            └─ tileset                                       where tiles are
//!                └─ lattice, tiles, grid ─► place             pixels of the map; values of pixels; where on the earth
//!                └─ scene, quadtree, parts                    the model; parts of its mesh
//! ```

mod accuracy;
mod cog;
mod colors;
mod confidence;
mod contours;
mod depths;
mod error;
mod floaters;
mod grid;
mod heights;
mod lattice;
mod parts;
mod place;
mod points;
mod quadtree;
mod scene;
mod solid;
mod splat_claims;
mod splat_tiles;
mod splats;
mod terrain;
#[cfg(test)]
mod tests;
mod tiles;
mod tileset;
mod views;
mod volumes;
mod witnesses;

use std::path::{Path, PathBuf};

use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_geo::Georeference;
use cosurf_scene::{LocalFrame, Mesh, atomic, files};
use glam::DVec3;

use crate::mesh::{FuseEvent, MeshError};
use crate::service::remove;
pub use accuracy::{Accuracy, MadeFile, PointsAccuracy};
use accuracy::{Made, accuracy_of};
use colors::Painter;
use confidence::{Claim, Scale, find_claims};
use contours::{ContourOrder, write_contours};
use depths::Depths;
pub use error::SurveyError;
use floaters::Floaters;
use heights::{Covered, Ground, Surface, find_heights};
use lattice::Lattice;
use place::Place;
use points::{Points, StoredPoints};
use quadtree::Quadtree;
pub use scene::FusedMesh;
use scene::{Relief, Scene};
use solid::{Shown, SolidSize, write_solid};
use splat_claims::write_splat_claims;
use splat_tiles::{SplatTiles, write_splat_tiles};
use splats::{Sieve, splats_from_above};
use terrain::{find_terrain, leave_trusted};
use tiles::Tiles;
use views::{Views, find_views};
pub use volumes::Volume;
use volumes::{check_near, find_volumes, read_polygons};
use witnesses::Witnesses;

/// Usual difference of height between two contours, metres.
pub const CONTOURS_M: f64 = 1.0;

/// Bytes of a tile with the largest pixels.
const TILE_BYTES: u64 = (lattice::TILE_PX * lattice::TILE_PX) as u64 * size_of::<Claim>() as u64;
/// Tiles in the memory while a map is written, beside those that the writer keeps for its overviews: as measured with a map of
/// four tiles.
const TILES_BESIDE: u64 = 3;
/// Most tiles that the writer keeps (`geotiff-writer`, the cache of its tiles).
const TILES_KEPT_MAX: u64 = 16;
/// Tiles of a map that any survey may write.
const TILES_LEAST: u64 = 4;
/// The smallest memory limit for any survey, bytes.
const LEAST_BYTES: u64 = PROCESS_BYTES + (TILES_LEAST + TILES_BESIDE) * TILE_BYTES;

/// What to make.
#[derive(Clone, Debug)]
pub struct SurveyOrder {
    /// Folder of the model: `global.ply` or `model.ply`, and `cameras.json`.
    pub folder: PathBuf,
    /// Folder of the deliverables.
    pub out: PathBuf,
    /// Where on the earth the model lies.
    pub georeference: Georeference,
    /// The mesh of the model, if there is one; otherwise it is fused.
    pub mesh: Option<FusedMesh>,
    /// Grid of the geoid that heights are above, as [`cosurf_geo::Geoid`] reads it; `None` for heights above the ellipsoid.
    pub geoid: Option<PathBuf>,
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
    /// Progress of a stage that goes through the tiles of the map, or through the cameras.
    Counted {
        /// What is counted: `tile` or `view`.
        what: &'static str,
        /// Name of the stage.
        stage: &'static str,
        /// Number done.
        done: usize,
        /// Number in all.
        of: usize,
    },
}

/// Makes all files: the maps `dsm.tif`, `dtm.tif`, `ortho.tif` and `confidence.tif`, `points.laz`, `mesh.glb`, `mesh.obj`
/// with `mesh.mtl` and `mesh.jpg`, `tileset.json` with its tiles, `splats/tileset.json` with its tiles, `splats.ply`,
/// `contours.geojson`, `volumes.json` if polygons are given, and last `accuracy.json`, so that its presence tells that the
/// others are complete.
pub fn survey(order: &SurveyOrder, mut on_event: impl FnMut(SurveyEvent)) -> Result<Accuracy, SurveyError> {
    let place = Place::new(&order.georeference, order.geoid.as_deref())?;
    // Read before the mesh is made, so that a wrong file is reported at once.
    let polygons = order.volumes.as_deref().map(|file| read_polygons(file, &place)).transpose()?;
    let scene = Scene::open(&order.folder)?;
    if let (Some(polygons), Some(file)) = (&polygons, &order.volumes) {
        check_near(polygons, file, &scene.cameras, &place)?;
    }
    check_memory(&scene, order)?;
    files::create_folder(&order.out)?;
    atomic::remove_partial_files(&order.out)?;
    points::remove_leftovers(&order.out)?;
    let out = |name| order.out.join(name);
    let accuracy_file = out("accuracy.json");
    remove(&accuracy_file)?; // its statement is of the files of an earlier run
    remove(&out("volumes.json"))?; // of polygons that may not be wanted this time

    let relief = match &order.mesh {
        Some(mesh) => scene.read_mesh(mesh)?,
        None => {
            let on_fusion = |event| on_event(SurveyEvent::Fusion(event));
            scene.fuse_mesh(order.memory_bytes, order.threads, on_fusion)?
        }
    };
    let mut show = |what, stage, done, of| on_event(SurveyEvent::Counted { what, stage, done, of });
    let voxel_m = relief.voxel_m;
    let shape = Shape::of(relief, &scene, place, order, &mut show)?;
    let Shape { lattice, mut heights, mut depths, points, solid, bounds } = shape;
    let mut terrain = Tiles::new(&order.out, lattice.size_px(), lattice::TILE_PX)?;
    find_terrain(&mut heights, lattice.gsd_m(), &mut terrain, order.memory_bytes)?;

    let seen = Seen { heights: &mut heights, depths: &mut depths, bounds, voxel_m };
    let splats = write_splats(&scene, order, &lattice, seen, &mut show)?;

    let mut views = Tiles::<Views>::new(&order.out, lattice.size_px(), lattice::TILE_PX)?;
    find_views(depths, &lattice, &mut heights, &mut views, voxel_m, |d, n| show("view", "comparing", d, n))?;
    let mut claims = Tiles::new(&order.out, lattice.size_px(), lattice::TILE_PX)?;
    let height_error_m = find_claims(&lattice, voxel_m, &mut heights, &mut views, &mut claims)?
        .ok_or(SurveyError::NothingSeen)?;
    cog::write_claims(&out("confidence.tif"), &lattice, &mut claims)?;
    cog::write_heights(&out("dsm.tif"), &lattice, &mut heights)?;
    let covered = Covered::of(&lattice, &mut heights)?.ok_or(SurveyError::NothingSeen)?;
    write_ground(&order.out, order, &lattice, &mut heights, &mut terrain)?;
    let points =
        points.read()?.trusted(&lattice, &mut heights)?.write(&out("points.laz"), lattice.place())?;
    let volumes = polygons.as_deref().map(|polygons| find_volumes(polygons, &lattice, &mut heights));
    let volumes = volumes.transpose()?;
    if let Some(volumes) = &volumes {
        atomic::write_bytes(&out("volumes.json"), volumes.to_json().as_bytes())?;
    }

    let cameras = scene.cameras.len();
    let made = Made { covered, height_error_m, points, solid, voxel_m, cameras, splats };
    let accuracy = accuracy_of(&order.georeference, &lattice, &made, order.contours_m, volumes.as_ref());
    atomic::write_bytes(&accuracy_file, accuracy.to_json().as_bytes())?;
    Ok(accuracy)
}

/// Refuses a limit that is too small for writing maps. Also asks what rendering needs then, so that the user need not try twice.
fn check_memory(scene: &Scene, order: &SurveyOrder) -> Result<(), SurveyError> {
    let memory_bytes = order.memory_bytes;
    if memory_bytes >= LEAST_BYTES {
        return Ok(());
    }
    match scene.fuse_mesh(0, order.threads, |_| ()) {
        Err(SurveyError::Mesh(MeshError::TooLittleMemory { needed_bytes, .. })) => {
            Err(SurveyError::TooLittleMemory { needed_bytes: needed_bytes.max(LEAST_BYTES), memory_bytes })
        }
        other => other.map(drop),
    }
}

/// Bytes that the process takes while a map of this size is written.
fn writing_bytes(size_px: [u32; 2]) -> u64 {
    let tiles: u64 = size_px.map(|side| u64::from(side.div_ceil(lattice::TILE_PX))).iter().product();
    PROCESS_BYTES + (tiles.clamp(TILES_LEAST, TILES_KEPT_MAX) + TILES_BESIDE) * TILE_BYTES
}

/// Refuses a map whose writing takes more than the limit.
fn check_map(lattice: &Lattice, memory_bytes: u64) -> Result<(), SurveyError> {
    let (size_px, needed_bytes) = (lattice.size_px(), writing_bytes(lattice.size_px()));
    match needed_bytes <= memory_bytes {
        true => Ok(()),
        false => Err(SurveyError::LittleForMap { size_px, needed_bytes, memory_bytes }),
    }
}

/// What the mesh gives.
struct Shape {
    lattice: Lattice,
    heights: Tiles<f32>,
    /// What each camera shows.
    depths: Depths,
    /// The vertices that enough cameras see.
    points: StoredPoints,
    solid: SolidSize,
    /// Lowest and highest coordinates of these vertices, in the world.
    bounds: [DVec3; 2],
}

/// The surface that splats are compared with, and what cameras show.
struct Seen<'a> {
    heights: &'a mut Tiles<f32>,
    depths: &'a mut Depths,
    bounds: [DVec3; 2],
    voxel_m: f64,
}

impl Shape {
    /// Writes the files that show the mesh itself, and finds the heights of the map. The mesh is gone afterwards.
    fn of(
        relief: Relief,
        scene: &Scene,
        place: Place,
        order: &SurveyOrder,
        mut show: impl FnMut(&'static str, &'static str, usize, usize),
    ) -> Result<Self, SurveyError> {
        let Relief { mesh, voxel_m } = relief;
        let out = &order.out;
        let witnesses = Witnesses::of(&scene.cameras);
        let mut ground = Ground::of(&mesh, &scene.frame, &scene.cameras, &witnesses, &place)?;
        let mut depths = Depths::new(out)?;
        let mut floaters = Floaters::new(&mesh, &scene.frame, voxel_m);
        let held_bytes = floaters.held_bytes(&ground.is_seen);
        scene.render_each(order.memory_bytes, held_bytes, order.threads, |[done, of], map| {
            floaters.add(map, &ground.is_seen);
            depths.push(map)?;
            show("view", "looking through", done, of);
            Ok(())
        })?;
        floaters.leave_out(&mut ground.is_seen);
        let gsd_m = order.gsd_m.unwrap_or(ground.gsd_m);
        let lattice = Lattice::around(place, &ground.extent, gsd_m)?;
        check_map(&lattice, order.memory_bytes)?;
        let place = lattice.place();
        let bounds = bounds_of(&mesh, &ground.is_seen, &scene.frame);
        let points = Points::of(&mesh, &ground.is_seen, place, &scene.frame)?.store(out)?;
        let tree = Quadtree::of(&mesh, &ground.is_seen).ok_or(SurveyError::NothingSeen)?;
        let held_bytes = parts::bytes(&mesh) + tree.bytes() + size_of_val(&ground.is_seen[..]) as u64;
        let bytes = order.memory_bytes.saturating_sub(PROCESS_BYTES + held_bytes);
        let mut on_view = |d, n| show("view", "painting", d, n);
        let shown = Shown { depths: &mut depths, gsd_m: ground.gsd_m, bytes, on_view: &mut on_view };
        let solid = write_solid(out, &mesh, &tree, &scene.frame, place, voxel_m, shown)?;
        let surface = Surface { mesh: &mesh, tree: &tree, frame: &scene.frame, ceiling_m: ground.ceiling_m };
        let mut heights = Tiles::new(out, lattice.size_px(), lattice::TILE_PX)?;
        let on_tile = |d, n| show("tile", "heights", d, n);
        if !find_heights(&surface, &witnesses, &lattice, &mut heights, on_tile)? {
            return Err(SurveyError::NothingSeen);
        }
        Ok(Self { lattice, heights, depths, points, solid, bounds })
    }
}

/// Lowest and highest coordinates of the vertices that enough cameras see, in the world.
fn bounds_of(mesh: &Mesh, is_seen: &[bool], frame: &LocalFrame) -> [DVec3; 2] {
    let seen = mesh.positions.iter().zip(is_seen).filter(|(_, is_seen)| **is_seen);
    let world = seen.map(|(at, _)| frame.world_from_local(at.map(f64::from).into()));
    world.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], at| [low.min(at), high.max(at)])
}

/// Writes the orthophoto, and the splats themselves: with what can be claimed of each, and as tiles.
fn write_splats(
    scene: &Scene,
    order: &SurveyOrder,
    lattice: &Lattice,
    seen: Seen,
    mut show: impl FnMut(&'static str, &'static str, usize, usize),
) -> Result<SplatTiles, SurveyError> {
    let memory_bytes = order.memory_bytes;
    let Seen { heights, depths, bounds, voxel_m } = seen;
    let sieve = Sieve::new(scene, lattice, heights, bounds, voxel_m);
    let kept = splats_from_above(scene, sieve, &order.out, memory_bytes)?;
    let mut colors = Tiles::new(&order.out, lattice.size_px(), lattice::TILE_PX)?;
    let painter = Painter { splats: kept.file(), frame: scene.frame, memory_bytes, threads: order.threads };
    painter.paint(lattice, heights, &mut colors, |d, n| show("tile", "colours", d, n))?;
    cog::write_colors(&order.out.join("ortho.tif"), lattice, &mut colors)?;
    let scale = Scale::of(lattice, voxel_m);
    let on_view = |d, n| show("view", "comparing splats", d, n);
    write_splat_claims(&order.out, scene, kept.floats(), depths, &scale, memory_bytes, on_view)?;
    write_splat_tiles(&order.out, scene, kept.floats(), lattice.place(), memory_bytes)
}

/// Writes the terrain and its contours, as far as the heights can be trusted.
fn write_ground(
    out: &Path,
    order: &SurveyOrder,
    lattice: &Lattice,
    trusted: &mut Tiles<f32>,
    terrain: &mut Tiles<f32>,
) -> Result<(), SurveyError> {
    let range_m = leave_trusted(terrain, trusted, lattice.gsd_m(), order.memory_bytes)?;
    cog::write_heights(&out.join("dtm.tif"), lattice, terrain)?;
    let contours = ContourOrder { step_m: order.contours_m, range_m, memory_bytes: order.memory_bytes };
    write_contours(&out.join("contours.geojson"), lattice, terrain, &contours)
}
