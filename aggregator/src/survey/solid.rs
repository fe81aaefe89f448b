//! The surface as triangles: `mesh.glb` (glTF 2.0), `mesh.obj` in the coordinates of the maps, and the same as 3D Tiles 1.1 (`tileset.json` and the folder `tiles`)
//! for viewers that load only what they show.
//!
//! The mesh is cut into the leaves of a quadtree, and each leaf is decimated to an error bound. Four decimated leaves,
//! joined and decimated further, are the tile above them, and so on to the root. Vertices on the border between two tiles of
//! one level stay, so neighbours fit together. `mesh.glb` is all leaves together.
//!
//! The colours of `mesh.glb` and `mesh.obj` are a picture, `mesh.jpg`, painted with what the cameras show; if there is too
//! little memory for it, they belong to the vertices. Those of tiles always do, and decimation keeps vertices where colours
//! change.
//!
//! What it knows nothing about: how the mesh was made, maps.
//!
//! Where to start reading: [`write_solid`]; [`decimate`] has the error bound.

mod decimate;
mod texture;

use std::collections::BTreeMap;
use std::path::Path;

use cosurf_geo::GeoError;
use cosurf_scene::{LocalFrame, Mesh, atomic};
use glam::DVec3;
use rayon::prelude::*;
use serde_json::{Map, Value, json};

use super::depths::Depths;
use super::error::SurveyError;
use super::parts;
use super::place::Place;
use super::quadtree::{Key, Quadtree, parent, shared};
use super::tileset::{self, Bounds, Tile, tileset};
use crate::service::remove;
use decimate::{Bound, Decimated, decimate};
use texture::{TextureOrder, Textured, texture};

/// Folder of the tiles.
const FOLDER: &str = "tiles";
/// Coordinates of `mesh.obj` are without multiples of this, metres.
const OFFSET_STEP_M: f64 = 1000.0;
/// The error of the finest tiles and of `mesh.glb`, as a share of a voxel: less than the mesh itself is wrong.
const ERROR_VOXELS: f64 = 0.5;
/// How many times as large the error of a tile is as that of the tiles below it. In the built-in city, a tile then has two to
/// three times as many triangles as each of these.
const COARSER: f64 = 3.0;

/// What was written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SolidSize {
    /// Number of triangles of `mesh.glb`.
    pub(super) triangles: usize,
    /// Bound on its error, metres.
    pub(super) error_m: f64,
    /// Side of a texel of `mesh.jpg`, metres; `None` if colours belong to vertices.
    pub(super) texel_m: Option<f64>,
    /// Number of levels of detail of the tileset.
    pub(super) levels: usize,
}

/// What the cameras show, for the texture.
pub(super) struct Shown<'a> {
    pub(super) depths: &'a mut Depths,
    /// Length that a pixel of the cameras covers on the surface, metres.
    pub(super) gsd_m: f64,
    /// Memory for the texture and for what [`write_solid`] itself holds, bytes.
    pub(super) bytes: u64,
    /// Gets the number of cameras that are painted, and of all.
    pub(super) on_view: &'a mut dyn FnMut(usize, usize),
}

/// Writes the triangles of a tree. The mesh is in `frame`, with voxels of `voxel_m`.
pub(super) fn write_solid(
    out: &Path,
    mesh: &Mesh,
    tree: &Quadtree,
    frame: &LocalFrame,
    place: &Place,
    voxel_m: f64,
    shown: Shown<'_>,
) -> Result<SolidSize, SurveyError> {
    let folder = out.join(FOLDER);
    tileset::make_folder(&folder)?;
    let bounds = |triangles: &[[u32; 3]]| {
        let world =
            |vertex: &u32| frame.world_from_local(mesh.positions[*vertex as usize].map(f64::from).into());
        Bounds::around(triangles.as_flattened().iter().map(world))
    };
    let mut error_m = ERROR_VOXELS * voxel_m;
    let bound = |error_m: f64| Bound { error: error_m / frame.unit() };
    let is_shared = tree.shared_by_leaves(mesh);
    let leaves: Vec<Key> = tree.leaves().collect();
    let leaf = |key: &Key| {
        let Decimated { triangles, .. } =
            decimate(mesh, &tree.triangles(mesh, *key), &is_shared, bound(error_m));
        (*key, Node { tile: Tile { bounds: bounds(&triangles), error_m: 0.0 }, triangles })
    };
    let mut level: BTreeMap<Key, Node> = leaves.par_iter().map(leaf).collect();
    let all: Vec<[u32; 3]> = level.values().flat_map(|node| node.triangles.iter().copied()).collect();
    let whole = parts::part(mesh, &all).out_of_frame(frame);
    let (triangles, levels) = (all.len(), tree.depth() as usize + 1);
    let held_bytes = (size_of_val(&is_shared[..]) + 2 * size_of_val(&all[..])) as u64;
    drop(all);
    let texel_m = write_whole(
        out,
        whole,
        place,
        voxel_m,
        Shown { bytes: shown.bytes.saturating_sub(held_bytes), ..shown },
    )?;
    let size = SolidSize { triangles, error_m, texel_m, levels };

    let mut tiles = BTreeMap::new();
    for depth in (0..=tree.depth()).rev() {
        for (key, node) in &level {
            let name = tileset::name(depth, *key);
            let part = parts::part(mesh, &node.triangles).out_of_frame(frame);
            part.write_glb(&folder.join(name), &Map::new())?;
            tiles.insert((depth, *key), node.tile);
        }
        if depth > 0 {
            error_m *= COARSER;
            level = coarser(mesh, level, bound(error_m), frame.unit());
        }
    }
    let json = tileset(&tiles, &format!("{FOLDER}/"), place.ecef_from_enu());
    atomic::write_bytes(&out.join("tileset.json"), json.to_string().as_bytes())?;
    Ok(size)
}

/// Writes a mesh of the world to `mesh.glb` and `mesh.obj`, with a texture if there is memory for it. Returns the side of a
/// texel, metres.
fn write_whole(
    out: &Path,
    mesh: Mesh,
    place: &Place,
    voxel_m: f64,
    shown: Shown<'_>,
) -> Result<Option<f64>, SurveyError> {
    let [glb, obj, picture, material] =
        ["mesh.glb", "mesh.obj", "mesh.jpg", "mesh.mtl"].map(|name| out.join(name));
    for file in [&picture, &material] {
        remove(file)?; // of an earlier run, which may have had more memory
    }
    let bytes = shown.bytes.saturating_sub(parts::bytes(&mesh));
    let order = TextureOrder { picture, gsd_m: shown.gsd_m, voxel_m, bytes };
    let Some(Textured { mesh, texture, texel_m }) = texture(&mesh, shown.depths, &order, shown.on_view)?
    else {
        mesh.write_glb(&glb, &extras(place))?;
        let (mesh, comment) = on_map(mesh, place)?;
        mesh.write_obj(&obj, &comment)?;
        return Ok(None);
    };
    mesh.write_textured_glb(&glb, &texture, &extras(place))?;
    let (mesh, comment) = on_map(mesh, place)?;
    mesh.write_textured_obj(&obj, &texture, &comment)?;
    Ok(Some(texel_m))
}

/// A mesh of the world in the coordinates of the map, without their whole kilometres, since tools that read OBJ have numbers
/// of 32 bits; and a line that tells so.
fn on_map(mut mesh: Mesh, place: &Place) -> Result<(Mesh, String), GeoError> {
    let map = |position: [f32; 3]| place.map_from_enu(mesh.origin + DVec3::from(position.map(f64::from)));
    let first = mesh.positions.first().map_or(Ok(DVec3::ZERO), |first| map(*first))?;
    let offset = ((first / OFFSET_STEP_M).floor() * OFFSET_STEP_M).truncate().extend(0.0);
    let positions: Result<Vec<[f32; 3]>, GeoError> =
        mesh.positions.iter().map(|position| Ok((map(*position)? - offset).as_vec3().to_array())).collect();
    (mesh.positions, mesh.origin) = (positions?, DVec3::ZERO);
    let comment = format!(
        "EPSG:{}, {}; add {} to x and {} to y",
        place.projection().epsg(),
        place.heights(),
        offset.x,
        offset.y
    );
    Ok((mesh, comment))
}

/// A tile of the level that is worked on.
struct Node {
    tile: Tile,
    triangles: Vec<[u32; 3]>,
}

/// The tiles above those of a level.
fn coarser(mesh: &Mesh, level: BTreeMap<Key, Node>, bound: Bound, unit_m: f64) -> BTreeMap<Key, Node> {
    let mut joined: BTreeMap<Key, Node> = BTreeMap::new();
    for (key, mut node) in level {
        match joined.get_mut(&parent(key)) {
            Some(parent) => {
                parent.triangles.append(&mut node.triangles);
                parent.tile = parent.tile.joined(&node.tile);
            }
            None => _ = joined.insert(parent(key), node),
        }
    }
    let is_shared = shared(
        mesh.positions.len(),
        joined.iter().flat_map(|(key, node)| node.triangles.iter().map(|triangle| (*key, *triangle))),
    );
    let decimated = |(key, node): (Key, Node)| {
        let Decimated { triangles, error } = decimate(mesh, &node.triangles, &is_shared, bound);
        // The errors of the levels below add up.
        let error_m = node.tile.error_m + error * unit_m;
        (key, Node { tile: Tile { error_m, ..node.tile }, triangles })
    };
    joined.into_par_iter().map(decimated).collect()
}

/// Where the mesh lies on the earth. glTF has no words of its own for that.
fn extras(place: &Place) -> Map<String, Value> {
    let origin = place.origin();
    let extras = json!({
        "frame": "x east, y up, z south of the origin, metres",
        "origin": {
            "latitude_deg": origin.latitude_deg,
            "longitude_deg": origin.longitude_deg,
            "height_m": origin.height_m,
        },
        "epsg": place.projection().epsg(),
    });
    match extras {
        Value::Object(extras) => extras,
        _ => Map::new(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use super::super::place::tests::place;
    use super::*;

    /// A hilly square of 400 × 400 cells of 0.5 m, whose colour changes in the middle.
    fn hills() -> Mesh {
        let side = 401u32;
        let at = |i: u32| [i % side, i / side].map(|of| 0.5 * of as f32);
        let height = |[x, y]: [f32; 2]| 3.0 * (0.1 * x).sin() * (0.08 * y).cos();
        let vertices = 0..side * side;
        let cells = (0..side * (side - 1)).filter(|i| i % side + 1 < side);
        Mesh {
            positions: vertices.clone().map(|i| [at(i)[0], at(i)[1], height(at(i))]).collect(),
            rgb: vertices.map(|i| if at(i)[0] < 100.0 { [200, 40, 40] } else { [40, 40, 200] }).collect(),
            triangles: cells.flat_map(|i| [[i, i + 1, i + side + 1], [i, i + side + 1, i + side]]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn tiles_fit_together_and_errors_grow_towards_the_root() {
        let mesh = hills();
        let out = tempfile::tempdir().unwrap();
        fs::create_dir(out.path().join(FOLDER)).unwrap();
        fs::write(out.path().join("tiles/9-3.glb"), "of an earlier run").unwrap();
        let tree = Quadtree::of(&mesh, &vec![true; mesh.positions.len()]).unwrap();
        let mut depths = Depths::new(out.path()).unwrap();
        let shown = Shown { depths: &mut depths, gsd_m: 0.2, bytes: 0, on_view: &mut |_, _| () };
        let size = write_solid(out.path(), &mesh, &tree, &LocalFrame::WORLD, &place(), 0.1, shown).unwrap();
        assert_eq!((size.error_m, size.texel_m), (0.05, None));
        assert!(size.levels > 1 && size.triangles < mesh.triangles.len() / 4, "{size:?}");
        let json: Value =
            serde_json::from_slice(&fs::read(out.path().join("tileset.json")).unwrap()).unwrap();
        assert_eq!(json["asset"]["version"], "1.1");
        let obj = fs::read_to_string(out.path().join("mesh.obj")).unwrap();
        let map = place().map_from_enu(DVec3::new(200.0, 200.0, 0.0)).unwrap();
        let comment = "# EPSG:32633, metres above the ellipsoid of WGS 84; add 593000 to x and 5906000 to y";
        assert!(obj.starts_with(comment), "{}", &obj[..200]);
        let offset = DVec3::new(593_000.0, 5_906_000.0, 0.0);
        let of =
            |line: &str| -> Vec<f64> { line.split(' ').skip(1).map(|word| word.parse().unwrap()).collect() };
        let corner = |v: &Vec<f64>| (map.x - v[0] - offset.x).hypot(map.y - v[1] - offset.y) < 0.01;
        let found = obj.lines().filter(|line| line.starts_with("v ")).map(of).find(corner).unwrap();
        let height_m = 3.0 * f64::sin(20.0) * f64::cos(16.0) + 70.0;
        assert!((found[2] - height_m).abs() < 0.02 && (found[5] - 200.0 / 255.0).abs() < 1e-3, "{found:?}");
        assert_eq!(obj.lines().filter(|line| line.starts_with("f ")).count(), size.triangles);
        let mut pending = vec![(json["root"].clone(), f64::INFINITY)];
        let mut names = Vec::new();
        while let Some((tile, most_m)) = pending.pop() {
            let error_m = tile["geometricError"].as_f64().unwrap();
            assert!(error_m < most_m, "{error_m} m below {most_m} m");
            names.push(tile["content"]["uri"].as_str().unwrap().to_owned());
            let children = tile["children"].as_array().cloned().unwrap_or_default();
            assert_eq!(children.is_empty(), error_m == 0.0);
            pending.extend(children.into_iter().map(|child| (child, error_m)));
        }
        assert_eq!(names.len(), fs::read_dir(out.path().join(FOLDER)).unwrap().count());
        assert!(names.iter().all(|name| out.path().join(name).is_file()));
    }
}
