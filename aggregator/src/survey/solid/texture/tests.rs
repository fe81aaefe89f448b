//! Textures of surfaces whose colours are known.
#![allow(clippy::unwrap_used)]

use std::path::Path;

use cosurf_scene::Camera;
use glam::{DVec2, DVec3, Vec3};

use super::*;
use crate::survey::depths::DepthMap;
use crate::testing::above;

const GREY: [u8; 3] = [128; 3];

/// A floor of 8 m × 4 m, of two triangles, and a box of 2 m × 2 m × 1 m on it without a bottom, about a far origin.
fn floor_and_box() -> Mesh {
    let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
    let boxed = [0.0, 1.0].into_iter().flat_map(|z| corners.map(|[x, y]| [x, y, z]));
    let floor = [[-4.0, -2.0, 0.0], [4.0, -2.0, 0.0], [4.0, 2.0, 0.0], [-4.0, 2.0, 0.0]];
    let walls = (0..4).flat_map(|i| {
        let j = (i + 1) % 4;
        [[4 + i, 4 + j, 8 + j], [4 + i, 8 + j, 8 + i]]
    });
    Mesh {
        origin: DVec3::new(0.0, 0.0, -20.0),
        positions: floor.into_iter().chain(boxed).map(|[x, y, z]| [x, y, z + 20.0]).collect(),
        rgb: vec![GREY; 12],
        triangles: [[0, 1, 2], [0, 2, 3], [8, 9, 10], [8, 10, 11]].into_iter().chain(walls).collect(),
        ..Mesh::default()
    }
}

/// The colour of a point of the world: squares of half a metre, whose red grows with x and whose blue grows with y, so that
/// no two squares are alike; the top of the box is green.
fn color(at: DVec3) -> [u8; 3] {
    let square = (at / 0.5).floor();
    if at.z > 0.5 {
        return [20, 220, 20];
    }
    let is_dark = (square.x + square.y).rem_euclid(2.0) > 0.5;
    let bright = if is_dark { 0.0 } else { 60.0 };
    [100.0 + 10.0 * square.x + bright, 60.0, 100.0 + 20.0 * square.y + bright].map(|of| of as u8)
}

/// What a camera above the surface shows.
fn shown(camera: Camera) -> DepthMap {
    let [width, height] = camera.size_px;
    let mut map = DepthMap { camera, depth_m: Vec::new(), rgb: Vec::new() };
    for y in 0..height {
        for x in 0..width {
            let px = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let top = camera.unproject(px, 9.0);
            let depth_m = if top.truncate().abs().max_element() < 1.0 { 9.0 } else { 10.0 };
            map.depth_m.push(depth_m as f32);
            map.rgb.push(color(camera.unproject(px, depth_m)));
        }
    }
    map
}

/// What cameras above these places of the x axis show, with pixels of 2.5 cm on the floor.
fn depths(folder: &Path, places: &[f64]) -> Depths {
    let mut depths = Depths::new(folder).unwrap();
    for x in places {
        depths.push(&shown(above(*x).resized([480, 320]))).unwrap();
    }
    depths
}

fn order(folder: &Path, bytes: u64) -> TextureOrder {
    TextureOrder { picture: folder.join("mesh.jpg"), gsd_m: 0.1, voxel_m: 0.1, bytes }
}

/// The picture's colour at a place, blended as viewers do.
fn sampled(picture: &image::RgbImage, [u, v]: [f32; 2]) -> Vec3 {
    let at = |x: f32, y: f32| {
        let [x, y] = [(x as u32).min(picture.width() - 1), (y as u32).min(picture.height() - 1)];
        Vec3::from(picture.get_pixel(x, y).0.map(f32::from))
    };
    let [x, y] = [u * picture.width() as f32 - 0.5, v * picture.height() as f32 - 0.5];
    let (s, t) = (x.fract(), y.fract());
    at(x, y).lerp(at(x + 1.0, y), s).lerp(at(x, y + 1.0).lerp(at(x + 1.0, y + 1.0), s), t)
}

/// Calls `visit` with points of all triangles: the corners if `share` is 1, points near them otherwise; and the picture's
/// colour there.
fn each_point(textured: &Textured, share: f32, mut visit: impl FnMut(DVec3, Vec3, Vec3)) {
    let Textured { mesh, texture, .. } = textured;
    let picture = image::open(&texture.picture).unwrap().to_rgb8();
    for (i, triangle) in mesh.triangles.iter().enumerate() {
        let corners = mesh.corners(i);
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize();
        for k in 0..3 {
            let weights = [0, 1, 2].map(|j| if j == k { share } else { 0.5 * (1.0 - share) });
            let at = (0..3).map(|j| corners[j] * weights[j]).sum::<Vec3>();
            let uv = [0, 1]
                .map(|axis| (0..3).map(|j| texture.uv[triangle[j] as usize][axis] * weights[j]).sum::<f32>());
            visit(mesh.origin + at.as_dvec3(), normal, sampled(&picture, uv));
        }
    }
}

/// How far the worst of three colours is off.
fn off(a: Vec3, b: [u8; 3]) -> f32 {
    (a - Vec3::from(b.map(f32::from))).abs().max_element()
}

/// Number of points on the floor and on the box that have the colours of the surface, and of those that do not.
fn right_and_wrong(textured: &Textured) -> [usize; 2] {
    let mut counts = [0; 2];
    for share in [0.91, 0.7, 0.53, 0.44, 0.4, 0.34] {
        each_point(textured, share, |at, normal, found| {
            let to_line = (at / 0.5 - (at / 0.5).round()).abs().truncate().min_element() * 0.5;
            let is_hidden = at.z < 0.5 && at.truncate().abs().max_element() < 1.1;
            if normal.z > 0.9 && !is_hidden && to_line > 0.09 {
                counts[usize::from(off(found, color(at)) >= 14.0)] += 1;
            }
        });
    }
    counts
}

#[test]
fn squares_smaller_than_the_triangles_are_in_the_picture() {
    let folder = tempfile::tempdir().unwrap();
    let mut depths = depths(folder.path(), &[-2.0, 0.0, 2.0]);
    let found = texture(&floor_and_box(), &mut depths, &order(folder.path(), 1 << 26), |_, _| ());
    let mut textured = found.unwrap().unwrap();
    assert_eq!((textured.texel_m, textured.mesh.triangles.len()), (0.05, 12));
    assert!(textured.mesh.rgb.is_empty());
    let [right, wrong] = right_and_wrong(&textured);
    assert!(right > 20 && wrong == 0, "{right} right, {wrong} wrong");
    let [a, b, _] = textured.mesh.triangles[0].map(|vertex| vertex as usize);
    textured.texture.uv.swap(a, b);
    assert!(right_and_wrong(&textured)[1] > 5, "two corners that change places are noticed");
}

#[test]
fn charts_do_not_bleed_into_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let mut depths = depths(folder.path(), &[0.0]);
    let found = texture(&floor_and_box(), &mut depths, &order(folder.path(), 1 << 26), |_, _| ());
    let textured = found.unwrap().unwrap();
    let mut counts = [0; 2];
    for share in [1.0, 0.999] {
        each_point(&textured, share, |at, normal, found| {
            if normal.z.abs() < 0.1 {
                // The camera does not see the walls: they have the colours of their vertices, to the edge of the green top.
                assert!(off(found, GREY) < 12.0, "wall at {at}: {found}");
                counts[0] += 1;
            } else if at.z > 0.5 {
                assert!(off(found, color(at)) < 30.0, "top at {at}: {found}");
                counts[1] += 1;
            }
        });
    }
    assert_eq!(counts, [48, 12]);
}

#[test]
fn little_memory_makes_texels_wider_and_none_leaves_the_picture_out() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = floor_and_box();
    let mut depths = depths(folder.path(), &[0.0]);
    let shown_bytes = depths.largest_bytes();
    let fine = Layout::within(&mesh, &order(folder.path(), 1 << 26), shown_bytes).unwrap();
    let fixed = shown_bytes + 12 * TRIANGLE_BYTES;
    let all = fixed + fine.bytes();
    let with = |bytes| Layout::within(&mesh, &order(folder.path(), bytes), shown_bytes);
    assert_eq!(with(all).unwrap().texel_m, fine.texel_m);
    for bytes in [all - 1, fixed + fine.bytes() / 3] {
        let coarse = with(bytes).unwrap();
        assert!(coarse.texel_m > fine.texel_m && fixed + coarse.bytes() <= bytes, "{}", coarse.texel_m);
    }
    assert!(with(fixed + 1000).is_none());
    assert!(texture(&mesh, &mut depths, &order(folder.path(), fixed - 1), |_, _| ()).unwrap().is_none());
    assert!(!folder.path().join("mesh.jpg").exists());
}

#[test]
fn wide_surfaces_have_wider_texels_rather_than_larger_pictures() {
    let mut mesh = floor_and_box();
    mesh.positions.iter_mut().for_each(|at| at[0] *= 70.0);
    let order = TextureOrder { gsd_m: 0.05, voxel_m: 0.2, ..order(Path::new(""), 1 << 32) };
    let layout = Layout::within(&mesh, &order, 0).unwrap();
    assert!(layout.texel_m > 0.05 && layout.packed.size_px.iter().all(|side| *side <= SIDE_MAX_PX));
}

#[test]
fn pictures_do_not_depend_on_the_number_of_threads() {
    let written = |threads: usize| {
        let folder = tempfile::tempdir().unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut depths = depths(folder.path(), &[-2.0, 0.0, 2.0]);
        let order = order(folder.path(), 1 << 26);
        let textured =
            pool.install(|| texture(&floor_and_box(), &mut depths, &order, |_, _| ())).unwrap().unwrap();
        (std::fs::read(order.picture).unwrap(), textured.mesh, textured.texture.uv)
    };
    assert!(written(1) == written(2));
}
