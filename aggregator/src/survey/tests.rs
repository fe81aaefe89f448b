//! Surveys of a synthetic slope, whose heights are known.
#![allow(clippy::unwrap_used)]

mod memory;
mod splat_claims;
mod splat_tiles;
mod textured;
mod validated;

use std::path::Path;
use std::process::Command;

use cosurf_geo::{Geodetic, Georeference};
use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Camera, LocalFrame, Mesh, Splats, camera_list, ply};
use cosurf_tests::skips::skip;
use glam::{DVec2, DVec3};

use super::colors::Painter;
use super::floaters::Floaters;
use super::heights::{Ground, Surface, find_heights};
use super::lattice::Lattice;
use super::place::Place;
use super::quadtree::Quadtree;
use super::scene::Scene;
use super::splats::{Sieve, splats_from_above};
use super::tiles::Tiles;
use super::witnesses::Witnesses;
use super::{FusedMesh, SurveyError, SurveyEvent, SurveyOrder, survey};
use crate::testing::{above, geoid, undulation_m};

/// Splats of the slope.
const SPLATS: usize = 81 * 61;
/// Metres up per metre east.
const SLOPE: f64 = 0.2;
const MEMORY_BYTES: u64 = 1 << 30;
/// Bounds that no splat lies outside of.
const EVERYWHERE: [DVec3; 2] = [DVec3::splat(-1e6), DVec3::splat(1e6)];

fn georeference() -> Georeference {
    Georeference::at(Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 }).unwrap()
}

/// Nine cameras in a row, 10 m above the origin's plane, with pixels of a tenth of a metre there.
fn cameras() -> Vec<Camera> {
    (0..9).map(|i| above(f64::from(i) - 4.0).resized([120, 80])).collect()
}

/// A model in a folder: flat splats on the slope z = 0.2 x, half green and half blue, and a red one in mid-air.
fn model(folder: &Path) {
    let mut splats = Splats::with_capacity(0, 0);
    let half_angle = 0.5 * SLOPE.atan();
    let quat = [half_angle.cos() as f32, 0.0, -half_angle.sin() as f32, 0.0];
    let colors = |rgb: [f32; 3]| rgb.map(|value| (value - 0.5) / SH_C0);
    for i in -40..=40 {
        for j in -30..=30 {
            let [x, y] = [i, j].map(|of| 0.25 * of as f32);
            let color = colors(if y < 0.0 { [0.1, 0.8, 0.2] } else { [0.1, 0.2, 0.8] });
            splats.push([x, y, SLOPE as f32 * x], quat, [-1.8, -1.8, -6.0], 5.0, &color);
        }
    }
    // Above all cameras: it would hide a square metre of the map, but hides nothing from them.
    splats.push([0.0, 1.0, 12.0], [1.0, 0.0, 0.0, 0.0], [-1.0, -1.0, -3.0], 5.0, &colors([1.0, 0.0, 0.0]));
    ply::write(&folder.join("global.ply"), &splats, &LocalFrame::WORLD).unwrap();
    camera_list::write(&folder.join(camera_list::FILE), &cameras()).unwrap();
}

fn order(folder: &Path) -> SurveyOrder {
    SurveyOrder {
        folder: folder.into(),
        out: folder.join("out"),
        georeference: georeference(),
        mesh: None,
        geoid: None,
        gsd_m: Some(0.1),
        contours_m: 0.5,
        volumes: None,
        memory_bytes: MEMORY_BYTES,
        threads: 2,
    }
}

/// The heights of a map with tiles of this side, px, pixel by pixel.
fn heights(scene: &Scene, folder: &Path, tile_px: u32) -> (Lattice, Vec<f32>) {
    let relief = scene.fuse_mesh(MEMORY_BYTES, 2, |_| ()).unwrap();
    let witnesses = Witnesses::of(&scene.cameras);
    let place = Place::new(&georeference(), None).unwrap();
    let ground = Ground::of(&relief.mesh, &scene.frame, &scene.cameras, &witnesses, &place).unwrap();
    let tree = Quadtree::of(&relief.mesh, &ground.is_seen).unwrap();
    let surface =
        Surface { mesh: &relief.mesh, tree: &tree, frame: &scene.frame, ceiling_m: ground.ceiling_m };
    let lattice = Lattice::around(place, &ground.extent, 0.1).unwrap();
    let mut tiles = Tiles::new(folder, lattice.size_px(), tile_px).unwrap();
    find_heights(&surface, &witnesses, &lattice, &mut tiles, |_, _| ()).unwrap();
    let all = whole(&mut tiles, 0.0);
    (lattice, all)
}

#[test]
fn heights_are_those_of_the_slope_and_tiles_leave_no_seams() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    let (lattice, large) = heights(&scene, folder.path(), 512);
    let (_, small) = heights(&scene, folder.path(), 32);
    let bits = |heights: &[f32]| heights.iter().map(|height| height.to_bits()).collect::<Vec<_>>();
    assert!(bits(&large) == bits(&small), "the tiles' size must not matter");

    let (width, mut errors) = (lattice.size_px()[0] as usize, Vec::new());
    let mut seen_far_east = false;
    for (i, height) in large.iter().enumerate().filter(|(_, height)| !height.is_nan()) {
        let px = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let column = lattice.place().column(lattice.map_from_px(px), 0.0).unwrap();
        // The second camera from the end is 3 m from the middle, and sees 0.6 m to each side per metre of depth.
        let depth = 10.0 - SLOPE * column.at.x;
        let reach = DVec2::new(3.01 + 0.6 * depth, 0.01 + 0.4 * depth);
        assert!(column.at.abs().cmplt(reach).all(), "{}", column.at);
        seen_far_east |= column.at.x > 7.0;
        // The outermost splats are half a splat wide at the edge of the slope.
        if column.at.x.abs() < 6.0 && column.at.y.abs() < 3.0 {
            errors.push((f64::from(*height) - 70.0 - SLOPE * column.at.x).abs());
        }
    }
    assert!(errors.len() > 6500 && seen_far_east, "{}", errors.len());
    let worst = errors.iter().copied().fold(0.0, f64::max);
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    assert!(worst < 0.03 && mean < 0.01, "worst {worst} m, mean {mean} m");
}

#[test]
fn all_files_are_written_and_readers_understand_them() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let polygons = folder.path().join("field.geojson");
    // 4 m × 4 m about the origin: in degrees, 6e-5 × 3.6e-5.
    let ring = "[[16.39997,53.299982],[16.40003,53.299982],[16.40003,53.300018],[16.39997,53.300018],[16.39997,53.299982]]";
    std::fs::write(&polygons, format!(r#"{{"type":"Polygon","coordinates":[{ring}]}}"#)).unwrap();
    let order = SurveyOrder { volumes: Some(polygons), ..order(folder.path()) };
    let accuracy = survey(&order, |_| ()).unwrap();
    assert_eq!((accuracy.epsg, accuracy.gsd_m, accuracy.splats_left_out), (32_633, 0.1, 1));
    assert_eq!((accuracy.splats, accuracy.splat_levels), (SPLATS, 1));
    assert!((100.0..180.0).contains(&accuracy.covered_m2), "{accuracy:?}");
    assert!(accuracy.check.is_none() && accuracy.points_per_m2 > 10.0, "{accuracy:?}");

    let out = |name: &str| order.out.join(name);
    let mut points = las::Reader::from_path(out("points.laz")).unwrap();
    assert_eq!(points.header().number_of_points(), accuracy.points);
    assert!(points.header().has_wkt_crs());
    let place = Place::new(&order.georeference, None).unwrap();
    let middle = place.map_from_enu(DVec3::ZERO).unwrap();
    for point in points.read_all().unwrap().points().map(Result::unwrap) {
        let from = DVec3::new(point.x, point.y, point.z) - middle;
        // Grid north is 1.1° from north here, and the slope goes east.
        assert!((from.z - SLOPE * from.x).abs() < 0.1 && from.length() < 14.0, "{from}");
        assert!(point.color.unwrap().red < 0x4000, "no point is red");
    }
    let splats = ply::read(&out("splats.ply"), &LocalFrame::WORLD).unwrap();
    let model = ply::read(&folder.path().join("global.ply"), &LocalFrame::WORLD).unwrap();
    assert!(splats == model.without(&[SPLATS as u32]), "the others are as they were");
    assert!(splat_claims::properties(&out("splats.ply")).iter().any(|[views, ..]| *views == 9.0));
    let volumes: serde_json::Value =
        serde_json::from_slice(&std::fs::read(out("volumes.json")).unwrap()).unwrap();
    let volume = |name: &str| volumes[0][name].as_f64().unwrap();
    assert!((volume("area_m2") - 16.03).abs() < 0.1 && (volume("mean_height_m") - 70.0).abs() < 0.02);
    assert!(volume("cut_m3") < 0.2 && volume("fill_m3") < 0.2 && volume("covered_share") > 0.97);
    let contours = std::fs::read_to_string(out("contours.geojson")).unwrap();
    let geojson::GeoJson::FeatureCollection(contours) = contours.parse().unwrap() else {
        panic!("{contours}")
    };
    let mut levels: Vec<f64> =
        contours.features.iter().map(|of| of.property("height_m").unwrap().as_f64().unwrap()).collect();
    levels.dedup();
    assert!(levels.contains(&70.0) && levels.contains(&71.0) && levels.len() >= 5, "{levels:?}");
    check_with_gdal(&out("dsm.tif"), &out("ortho.tif"));
    validated::check(&order.out, accuracy.points);
    assert_eq!(accuracy.texel_m, Some(0.05), "half of a pixel of the cameras");
    textured::check(&order.out, middle, accuracy.triangles);
}

#[test]
fn heights_above_a_geoid_are_told_in_every_file() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let order = SurveyOrder { geoid: Some(geoid(folder.path())), ..order(folder.path()) };
    let accuracy = survey(&order, |_| ()).unwrap();
    let told = "metres above the geoid of egm96_15.gtx, EPSG:5773";
    assert_eq!(accuracy.heights, told);
    // The slope has 70 m above the ellipsoid in its middle, where the geoid has 29.9 m.
    let [low_m, high_m] = accuracy.height_range_m;
    let middle_m = 70.0 - undulation_m(16.4, 53.3);
    assert!(low_m < middle_m && middle_m < high_m && high_m - low_m < 6.0, "{low_m} {middle_m} {high_m}");
    let out = |name: &str| order.out.join(name);
    let obj = std::fs::read_to_string(out("mesh.obj")).unwrap();
    assert!(obj.lines().next().is_some_and(|line| line.contains(told)));
    let points = las::Reader::from_path(out("points.laz")).unwrap();
    let wkt = points.header().get_wkt_crs_bytes().unwrap();
    let wkt = String::from_utf8_lossy(wkt);
    assert!(wkt.starts_with("COMPD_CS[") && wkt.contains(r#"AUTHORITY["EPSG","5773"]"#), "{wkt}");
    let middle = Place::new(&order.georeference, None).unwrap().map_from_enu(DVec3::ZERO).unwrap();
    if Command::new("gdalinfo").arg("--version").output().is_err() {
        return skip("REQUIRE_GDAL", "gdalinfo is not installed");
    }
    for map in ["dsm.tif", "dtm.tif", "confidence.tif", "ortho.tif"] {
        let info = Command::new("gdalinfo").arg("-json").arg(out(map)).output().unwrap();
        let info: serde_json::Value = serde_json::from_slice(&info.stdout).unwrap();
        let wkt = info["coordinateSystem"]["wkt"].as_str().unwrap();
        assert!(wkt.contains("EGM96 height") && wkt.contains("32633"), "{map}: {wkt}");
    }
    let height = values_at(&out("dsm.tif"), &[middle.x, middle.y + 1.5].map(|at| at.to_string()));
    assert!((height[0] - middle_m).abs() < 0.03, "{height:?} {middle_m}");
}

#[test]
fn a_mesh_that_is_there_is_not_fused_again() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    let relief = scene.fuse_mesh(MEMORY_BYTES, 2, |_| ()).unwrap();
    let (file, voxel_m) = (folder.path().join("mesh.ply"), relief.voxel_m);
    relief.mesh.out_of_frame(&scene.frame).write(&file).unwrap();
    let (mut fusions, mut rendered) = (0, 0);
    let order = SurveyOrder { mesh: Some(FusedMesh { file, voxel_m }), ..order(folder.path()) };
    let count = |event| match event {
        SurveyEvent::Fusion(_) => fusions += 1,
        SurveyEvent::Counted { what: "view", stage: "looking through", .. } => rendered += 1,
        SurveyEvent::Counted { .. } => {}
    };
    let accuracy = survey(&order, count).unwrap();
    assert_eq!((fusions, rendered, accuracy.voxel_m), (0, cameras().len(), voxel_m));
    let fused = survey(&SurveyOrder { mesh: None, ..order }, |_| ()).unwrap();
    assert_eq!((accuracy.points, accuracy.triangles), (fused.points, fused.triangles));
    assert!((accuracy.height_error_m - fused.height_error_m).abs() < 1e-3);
}

#[test]
fn the_orthophoto_has_no_seams_between_tiles() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    let (lattice, heights) = heights(&scene, folder.path(), 512);
    let colors = |tile_px: u32| {
        let mut tiles = tiles_of(&heights, folder.path(), lattice.size_px(), tile_px);
        let (out, memory_bytes) = (folder.path(), MEMORY_BYTES);
        let sieve = Sieve::new(&scene, &lattice, &mut tiles, EVERYWHERE, 0.1);
        let kept = splats_from_above(&scene, sieve, out, memory_bytes).unwrap();
        assert_eq!(kept.floats().iter().filter(|floats| **floats).count(), 1, "only the red splat floats");
        let mut colors = Tiles::new(folder.path(), lattice.size_px(), tile_px).unwrap();
        let painter = Painter { splats: kept.file(), frame: scene.frame, memory_bytes, threads: 2 };
        painter.paint(&lattice, &mut tiles, &mut colors, |_, _| ()).unwrap();
        whole(&mut colors, [0; 4])
    };
    let (large, small) = (colors(512), colors(32));
    assert!(large.iter().filter(|color| color[3] == 255).count() > 10_000);
    // Cameras of other tiles see the splats at angles that differ by less than a milliradian.
    let differs = |(a, b): (&[u8; 4], &[u8; 4])| (0..4).any(|k| a[k].abs_diff(b[k]) > 2) && a[3] == 255;
    let count = large.iter().zip(&small).filter(|(a, b)| differs((a, b))).count();
    assert!(count * 1000 < large.len(), "{count} of {} pixels differ", large.len());
}

/// A survey that is killed while it writes points leaves a file of the library, which has a name of its own.
#[test]
fn what_a_killed_survey_has_left_is_removed() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let order = order(folder.path());
    std::fs::create_dir(&order.out).unwrap();
    for name in ["..pointsAV9mlY.partial.eAw1IU.part", ".pointsAV9mlY.partial", "volumes.json"] {
        std::fs::write(order.out.join(name), "left").unwrap();
    }
    survey(&order, |_| ()).unwrap();
    let names = std::fs::read_dir(&order.out).unwrap().map(|entry| entry.unwrap().file_name());
    let left: Vec<_> = names.filter(|name| name.to_str().unwrap().starts_with('.')).collect();
    assert!(left.is_empty() && !order.out.join("volumes.json").exists(), "{left:?}");
}

/// They would make boxes of tiles reach far beyond what the tiles show.
#[test]
fn splats_far_outside_of_the_mesh_are_in_no_tile() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    let (lattice, heights) = heights(&scene, folder.path(), 512);
    let left_out = |bounds: [DVec3; 2]| {
        let mut tiles = tiles_of(&heights, folder.path(), lattice.size_px(), 512);
        let sieve = Sieve::new(&scene, &lattice, &mut tiles, bounds, 0.1);
        splats_from_above(&scene, sieve, folder.path(), MEMORY_BYTES).unwrap().floats().to_vec()
    };
    let (floating, narrow) = (left_out(EVERYWHERE), left_out([DVec3::splat(-1.0), DVec3::splat(1.0)]));
    let mut is_outside = Vec::new();
    let frame = scene.frame;
    let far = |mean: &[f32; 3]| {
        let at = frame.world_from_local(mean.map(f64::from).into()).abs().max_element();
        at > 1.0 + 0.5 * 12f64.sqrt()
    };
    scene.splats(1000, |part| is_outside.extend(part.means.iter().map(far))).unwrap();
    assert!((1..is_outside.len()).contains(&is_outside.iter().filter(|far| **far).count()));
    let wanted: Vec<bool> = floating.iter().zip(&is_outside).map(|(floats, far)| *floats || *far).collect();
    assert!(narrow == wanted);
}

/// The values of a map, pixel by pixel.
fn whole<T: bytemuck::Pod>(tiles: &mut Tiles<T>, nothing: T) -> Vec<T> {
    let width = tiles.size_px()[0] as usize;
    let mut all = vec![nothing; width * tiles.size_px()[1] as usize];
    for tile in 0..tiles.len() {
        let (window, values) = (tiles.window(tile), tiles.read(tile).unwrap());
        for (row, values) in values.chunks(window.size[0] as usize).enumerate() {
            let first = (window.at[1] as usize + row) * width + window.at[0] as usize;
            all[first..first + values.len()].copy_from_slice(values);
        }
    }
    all
}

/// The same map in tiles of this side, px.
fn tiles_of(heights: &[f32], folder: &Path, size_px: [u32; 2], tile_px: u32) -> Tiles<f32> {
    let mut tiles = Tiles::new(folder, size_px, tile_px).unwrap();
    for tile in 0..tiles.len() {
        let window = tiles.window(tile);
        let value = |i: u32| {
            let [x, y] = [window.at[0] + i % window.size[0], window.at[1] + i / window.size[0]];
            heights[(y * size_px[0] + x) as usize]
        };
        let values: Vec<f32> = (0..window.pixels() as u32).map(value).collect();
        tiles.write(tile, &values).unwrap();
    }
    tiles
}

/// Reads the maps with GDAL's programs, if they are there.
fn check_with_gdal(dsm: &Path, ortho: &Path) {
    let Ok(dsm_info) = Command::new("gdalinfo").arg("-json").arg(dsm).output() else {
        return skip("REQUIRE_GDAL", "gdalinfo is not installed");
    };
    let dsm_info: serde_json::Value = serde_json::from_slice(&dsm_info.stdout).unwrap();
    let wkt = dsm_info["coordinateSystem"]["wkt"].as_str().unwrap();
    assert!(wkt.contains("UTM zone 33N") && wkt.contains("32633"), "{wkt}");
    let [step_x, step_y] = [1, 5].map(|i| dsm_info["geoTransform"][i].as_f64().unwrap());
    assert_eq!([step_x, step_y], [0.1, -0.1]);
    let band = &dsm_info["bands"][0];
    assert_eq!(band["noDataValue"].as_f64(), Some(-9999.0));
    assert_eq!(band["type"], "Float32");
    let ortho_info = Command::new("gdalinfo").arg("-json").arg(ortho).output().unwrap();
    let ortho_info: serde_json::Value = serde_json::from_slice(&ortho_info.stdout).unwrap();
    assert_eq!(ortho_info["geoTransform"], dsm_info["geoTransform"]);
    assert_eq!(ortho_info["bands"].as_array().unwrap().len(), 4);
    // The pixels north and south of the middle, 1.5 m from it; the red splat is above the northern one.
    let middle = Place::new(&georeference(), None).unwrap().map_from_enu(DVec3::ZERO).unwrap();
    for (north_m, wanted) in [(1.5, [26.0, 51.0, 204.0]), (-1.5, [26.0, 204.0, 51.0])] {
        let at = [middle.x.to_string(), (middle.y + north_m).to_string()];
        let values = values_at(ortho, &at);
        assert_eq!((values.len(), values[3]), (4, 255.0), "{values:?}");
        assert!((0..3).all(|k| (values[k] - wanted[k]).abs() < 8.0), "{values:?}");
        for map in [dsm, &dsm.with_file_name("dtm.tif")] {
            let height = values_at(map, &at);
            assert!((height[0] - 70.0).abs() < 0.03, "{}: {height:?}", map.display());
        }
    }
}

/// The values of all bands at an easting and northing, by GDAL.
fn values_at(map: &Path, at: &[String; 2]) -> Vec<f64> {
    let output =
        Command::new("gdallocationinfo").args(["-valonly", "-geoloc"]).arg(map).args(at).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(|line| line.trim().parse().unwrap()).collect()
}

#[test]
fn impossible_surveys_are_refused_with_a_remedy() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let refused = |order: SurveyOrder| survey(&order, |_| ()).unwrap_err().to_string();
    let error = refused(SurveyOrder { memory_bytes: 1 << 20, ..order(folder.path()) });
    assert!(error.contains("allow more memory (--memory)"), "{error}");
    let error = refused(SurveyOrder { gsd_m: Some(1e-4), ..order(folder.path()) });
    assert!(error.contains("use --gsd"), "{error}");
    let error = refused(SurveyOrder { contours_m: 1e-4, ..order(folder.path()) });
    assert!(error.contains("use --contours"), "{error}");
    assert!(!folder.path().join("out/accuracy.json").exists(), "only a whole survey has a statement");
    let mut elsewhere = georeference();
    elsewhere.epsg = 4326;
    let error = refused(SurveyOrder { georeference: elsewhere, ..order(folder.path()) });
    assert!(error.contains("EPSG:4326"), "{error}");
    // One camera sees the ground, but nothing can be measured.
    camera_list::write(&folder.path().join(camera_list::FILE), &cameras()[..1]).unwrap();
    let error = survey(&order(folder.path()), |_| ()).unwrap_err();
    assert!(matches!(error, SurveyError::NothingSeen), "{error}");
}

#[test]
fn vertices_that_most_cameras_look_through_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    model(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    let at = [[0.0, -1.0, 0.0], [0.0, -1.0, 3.0], [2.0, 1.0, 0.4], [2.0, 1.0, 1.5], [2.0, 1.0, -2.0]];
    let local = |at: [f64; 3]| scene.frame.local_from_world(at.into()).as_vec3().to_array();
    let mesh = Mesh { positions: at.map(local).to_vec(), ..Mesh::default() };
    let mut is_seen = vec![true; 5];
    let mut floaters = Floaters::new(&mesh, &scene.frame, 0.1);
    let rendered = scene.render_each(MEMORY_BYTES, 0, 2, |_, map| {
        floaters.add(map, &is_seen);
        Ok(())
    });
    rendered.unwrap();
    floaters.leave_out(&mut is_seen);
    assert_eq!(is_seen, [true, false, true, false, true], "what the surface hides is not looked through");
}
