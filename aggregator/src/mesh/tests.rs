//! Views from all around a body with a known surface must give a closed mesh of the right size. Any memory
//! limit must be kept, and input without a surface must give a clear error.

#![allow(clippy::unwrap_used)]

use std::collections::HashMap;
use std::ops::ControlFlow;

use cosurf_engine::Rendering;
use cosurf_scene::{Camera, LocalFrame, Mesh, MeshCounts, Pose, Splats, ply};
use glam::{DVec2, DVec3, Vec3};

use super::extract::Layout;
use super::volume::Volume;
use super::*;

/// Goes on with a fusion.
const GO: ControlFlow<()> = ControlFlow::Continue(());
const SPHERE_RADIUS: f64 = 2.0;
/// Voxels fine enough that the box is large compared with the truncation distance.
const BOX_VOXEL_M: f64 = 0.05;
const BOX_HALF: DVec3 = DVec3::new(2.0, 1.5, 1.0);
/// Centre of the bodies, which is not symmetric to the voxel grid.
const CENTER: DVec3 = DVec3::new(1003.217, -411.893, 52.341);

/// A body around the origin, as a function of an eye and a viewing ray. Returns the distance from the eye to
/// the surface, in lengths of the ray; `None` if the ray misses the body.
type Body = fn(DVec3, DVec3) -> Option<f64>;

fn sphere(eye: DVec3, ray: DVec3) -> Option<f64> {
    let (a, half_b) = (ray.length_squared(), eye.dot(ray));
    let c = eye.length_squared() - SPHERE_RADIUS * SPHERE_RADIUS;
    let root = half_b * half_b - a * c;
    (root >= 0.0).then(|| (-half_b - root.sqrt()) / a)
}

fn cuboid(eye: DVec3, ray: DVec3) -> Option<f64> {
    let (a, b) = ((-BOX_HALF - eye) / ray, (BOX_HALF - eye) / ray);
    let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
    (enter <= leave).then_some(enter)
}

/// Cameras in evenly spread directions (a Fibonacci spiral), looking at the body from 10 m.
fn cameras(count: usize, size_px: u32) -> Vec<Camera> {
    let camera = |i: usize| {
        let z = 1.0 - (2 * i + 1) as f64 / count as f64;
        let angle = i as f64 * 2.399_963_229_728_653;
        let side = (1.0 - z * z).sqrt();
        let direction = DVec3::new(side * angle.cos(), side * angle.sin(), z);
        let up = if z.abs() > 0.9 { DVec3::X } else { DVec3::Z };
        Camera {
            cam_from_world: Pose::look_at(CENTER + 10.0 * direction, CENTER, up),
            focal_px: DVec2::splat(1.6 * f64::from(size_px)),
            center_px: DVec2::splat(0.5 * f64::from(size_px)),
            size_px: [size_px; 2],
        }
    };
    (0..count).map(camera).collect()
}

/// Renders an orange body with nothing around it.
fn look(body: Body, camera: &Camera) -> Rendering {
    let [width, height] = camera.size_px;
    let rotation = camera.cam_from_world.rotation.inverse();
    let eye = camera.cam_from_world.center() - CENTER;
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let depth: Vec<f32> = pixels
        .map(|(x, y)| {
            let ray = rotation * camera.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            body(eye, ray).unwrap_or(0.0) as f32
        })
        .collect();
    Rendering {
        size_px: camera.size_px,
        rgb: depth.iter().flat_map(|_| [1.0, 0.5, 0.25]).collect(),
        alpha: depth.iter().map(|z| f32::from(u8::from(*z > 0.0))).collect(),
        normal: Vec::new(),
        depth,
    }
}

fn settings(voxel_m: Option<f64>, memory_bytes: u64) -> FuseSettings {
    FuseSettings { voxel_m, memory_bytes }
}

fn fuse_body(body: Body, voxel_m: f64) -> Mesh {
    let cameras = cameras(60, 160);
    let settings = settings(Some(voxel_m), 1 << 30);
    fuse(&cameras, |camera: &Camera| look(body, camera), &settings, |_| GO).unwrap().mesh
}

/// Whether every edge belongs to two triangles that run along it in opposite directions.
fn is_closed(mesh: &Mesh) -> bool {
    let mut edges: HashMap<(u32, u32), u32> = HashMap::new();
    for &[a, b, c] in &mesh.triangles {
        for edge in [(a, b), (b, c), (c, a)] {
            *edges.entry(edge).or_default() += 1;
        }
    }
    edges.iter().all(|(&(a, b), &count)| count == 1 && edges.contains_key(&(b, a)))
}

/// Volume that a closed mesh encloses; positive if its triangles are counter-clockwise as seen from outside.
fn signed_volume(mesh: &Mesh) -> f64 {
    let from_center = |p: Vec3| p.as_dvec3() - CENTER;
    let volume = |i: usize| {
        let [a, b, c] = mesh.corners(i).map(from_center);
        a.dot(b.cross(c)) / 6.0
    };
    (0..mesh.triangles.len()).map(volume).sum()
}

/// Largest and mean distance of the vertices from a surface. `distance` gives the distance of a point,
/// relative to the bodies' centre.
fn offsets(mesh: &Mesh, distance: impl Fn(DVec3) -> f64) -> (f64, f64) {
    let distances = mesh.positions.iter().map(|p| distance(Vec3::from_array(*p).as_dvec3() - CENTER).abs());
    let (most, sum) = distances.fold((0.0f64, 0.0), |(most, sum), d| (most.max(d), sum + d));
    (most, sum / mesh.positions.len() as f64)
}

fn distance_to_box(p: DVec3) -> f64 {
    let beyond = p.abs() - BOX_HALF;
    beyond.max(DVec3::ZERO).length() + beyond.max_element().min(0.0)
}

#[test]
fn a_sphere_is_closed_and_of_the_right_size() {
    let mesh = fuse_body(sphere, 0.08);
    assert!(is_closed(&mesh));
    let volume = 4.0 / 3.0 * std::f64::consts::PI * SPHERE_RADIUS.powi(3);
    let found = signed_volume(&mesh);
    assert!((found / volume - 1.0).abs() < 0.02, "{found} of {volume}");
    let (most, mean) = offsets(&mesh, |p| p.length() - SPHERE_RADIUS);
    assert!(most < 0.5 * 0.08 && mean < 0.15 * 0.08, "{most} {mean}");
}

#[test]
fn a_box_is_closed_and_of_the_right_size() {
    let mesh = fuse_body(cuboid, BOX_VOXEL_M);
    assert!(is_closed(&mesh));
    let volume = 8.0 * BOX_HALF.element_product();
    let found = signed_volume(&mesh);
    assert!((found / volume - 1.0).abs() < 0.02, "{found} of {volume}");
    let (most, mean) = offsets(&mesh, distance_to_box);
    // The edges of the box bulge a little. A ray that cuts off an edge soon leaves the box again, but the
    // fusion takes everything just behind a surface for the inside.
    assert!(most < 2.0 * BOX_VOXEL_M && mean < 0.3 * BOX_VOXEL_M, "{most} {mean}");
}

#[test]
fn the_checks_notice_a_hole_and_a_flipped_triangle() {
    let mut mesh = fuse_body(sphere, 0.2);
    assert!(is_closed(&mesh) && signed_volume(&mesh) > 0.0);
    let [a, b, c] = mesh.triangles[7];
    mesh.triangles[7] = [b, a, c];
    assert!(!is_closed(&mesh), "one triangle is turned over");
    mesh.triangles.swap_remove(7);
    assert!(!is_closed(&mesh), "one triangle is missing");
    mesh.triangles.iter_mut().for_each(|triangle| triangle.reverse());
    assert!(signed_volume(&mesh) < 0.0, "all are turned over");
}

#[test]
fn normals_point_outwards_and_colors_match_the_pictures() {
    let mesh = fuse_body(sphere, 0.1);
    for ((position, normal), rgb) in mesh.positions.iter().zip(&mesh.normals).zip(&mesh.rgb) {
        let outward = (Vec3::from_array(*position).as_dvec3() - CENTER).normalize().as_vec3();
        let normal = Vec3::from_array(*normal);
        assert!(normal.is_normalized() && normal.dot(outward) > 0.9, "{normal} at {outward}");
        let near = |byte: u8, wanted: u8| byte.abs_diff(wanted) <= 1;
        assert!(near(rgb[0], 255) && near(rgb[1], 128) && near(rgb[2], 64), "{rgb:?}");
    }
}

#[test]
fn the_mesh_is_the_same_for_any_number_of_threads() {
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| fuse_body(cuboid, 0.1))
    };
    let one = with(1);
    assert!(one == with(3));
    assert!(one != fuse_body(cuboid, 0.1001), "the comparison notices differences");
}

#[test]
fn voxels_are_as_large_as_pixels_by_default() {
    let cameras = cameras(20, 100);
    let fused =
        fuse(&cameras, |camera: &Camera| look(sphere, camera), &settings(None, 1 << 30), |_| GO).unwrap();
    // Most of the sphere is 8 to 9 m away, and a pixel covers 1/160 of its distance.
    assert!((8.0 / 160.0..9.0 / 160.0).contains(&fused.pixel_m), "{}", fused.pixel_m);
    assert_eq!(fused.voxel_m, fused.pixel_m);
}

/// Goal: larger voxels keep any memory limit, and the growth is reported. Method: many views of a body whose
/// wanted voxels would take ten to a thousand times the limit.
#[test]
fn the_memory_limit_is_kept_by_larger_voxels() {
    let cameras = cameras(60, 64);
    for memory_bytes in [4 << 20, 12 << 20, 36 << 20] {
        let mut sizes = Vec::new();
        let fused = fuse(
            &cameras,
            |camera: &Camera| look(sphere, camera),
            &settings(Some(0.004), memory_bytes),
            |event| {
                if let FuseEvent::Coarser { wanted_m, voxel_m } = event {
                    assert_eq!(wanted_m, 0.004);
                    sizes.push(voxel_m);
                }
                GO
            },
        )
        .unwrap();
        assert!(fused.peak_bytes <= memory_bytes, "{} of {memory_bytes}", fused.peak_bytes);
        assert!(fused.peak_bytes > memory_bytes / 8, "{} of {memory_bytes}", fused.peak_bytes);
        assert!(sizes.is_sorted() && sizes.last() == Some(&fused.voxel_m), "{sizes:?}");
        assert!(is_closed(&fused.mesh));
    }
}

#[test]
fn a_volume_takes_the_bytes_that_it_reports() {
    let keys: Vec<_> = (0..100).filter_map(|x| volume::Key::new(glam::IVec3::new(x, 2, 3))).collect();
    let volume = Volume::new(keys, 0.1);
    let layout = Layout::new(&volume, volume.keys().len(), MeshCounts::default());
    assert_eq!(volume.bytes() + layout.bytes(), 100 * budget::BLOCK_BYTES);
}

#[test]
fn input_without_a_surface_gives_a_clear_error() {
    let all = cameras(12, 64);
    let refusal = |cameras: &[Camera], spoil: fn(&mut Rendering)| {
        let render = |camera: &Camera| {
            let mut rendering = look(sphere, camera);
            spoil(&mut rendering);
            rendering
        };
        fuse(cameras, render, &settings(Some(0.1), 1 << 26), |_| GO).unwrap_err()
    };
    assert!(matches!(refusal(&[], |_| ()), MeshError::NoCameras));
    let spoilers: [fn(&mut Rendering); 5] = [
        |rendering| rendering.depth.fill(f32::NAN),
        |rendering| rendering.depth.fill(f32::INFINITY),
        |rendering| rendering.depth.fill(0.0),
        |rendering| rendering.depth.fill(-9.0),
        |rendering| rendering.alpha.fill(0.4),
    ];
    for spoil in spoilers {
        let error = refusal(&all, spoil);
        assert!(matches!(error, MeshError::NoSurface) && !error.to_string().contains('\n'), "{error}");
    }
    // Only a small patch in the middle of each picture shows a surface, so the mesh has nothing but specks.
    let error = refusal(&all, |rendering| {
        let side = rendering.size_px[0] as usize;
        for (i, z) in rendering.depth.iter_mut().enumerate() {
            let is_middle = [i % side, i / side].iter().all(|at| 12 * at.abs_diff(side / 2) < side);
            *z = if is_middle { *z } else { 0.0 };
        }
    });
    assert!(matches!(error, MeshError::NoAgreement), "{error}");
}

#[test]
fn a_fusion_can_be_stopped_at_every_event() {
    let cameras = cameras(12, 64);
    let stopped_at = |last: usize| {
        let mut events = 0;
        let on_event = |_| {
            events += 1;
            if events > last { ControlFlow::Break(()) } else { GO }
        };
        let fused =
            fuse(&cameras, |camera: &Camera| look(sphere, camera), &settings(Some(0.1), 1 << 28), on_event);
        (fused, events)
    };
    for last in 0..3 * cameras.len() {
        let (fused, events) = stopped_at(last);
        assert!(matches!(fused, Err(MeshError::Stopped)) && events == last + 1, "{last}");
    }
    assert!(stopped_at(3 * cameras.len()).0.is_ok());
}

#[test]
fn some_nan_among_depths_and_colours_does_no_harm() {
    let cameras = cameras(60, 160);
    let spoilt = |camera: &Camera| {
        let mut rendering = look(sphere, camera);
        rendering.depth.iter_mut().step_by(37).for_each(|z| *z = f32::NAN);
        rendering.rgb.iter_mut().step_by(41).for_each(|v| *v = f32::NAN);
        rendering
    };
    let mesh = fuse(&cameras, spoilt, &settings(Some(0.1), 1 << 30), |_| GO).unwrap().mesh;
    assert!(is_closed(&mesh));
    assert!(mesh.positions.as_flattened().iter().all(|v| v.is_finite()));
}

#[test]
fn one_camera_gives_the_side_of_the_body_that_it_sees() {
    let one = &cameras(3, 160)[1..2];
    let mesh = fuse(one, |camera: &Camera| look(sphere, camera), &settings(Some(0.1), 1 << 28), |_| GO)
        .unwrap()
        .mesh;
    assert!(!is_closed(&mesh));
    let towards = (one[0].cam_from_world.center() - CENTER).normalize().as_vec3();
    for normal in &mesh.normals {
        assert!(Vec3::from_array(*normal).dot(towards) > -0.1, "{normal:?}");
    }
}

/// A horizontal square of opaque discs, for the cameras of [`cameras`] that look down from above.
fn wall() -> Splats {
    let mut splats = Splats::with_capacity(400, 0);
    for i in 0..400 {
        let at = CENTER + DVec3::new((i % 20) as f64 * 0.2 - 2.0, (i / 20) as f64 * 0.2 - 2.0, 0.0);
        let scales = [0.15f32.ln(), 0.15f32.ln(), 1e-3f32.ln()];
        splats.push(at.as_vec3().to_array(), [1.0, 0.0, 0.0, 0.0], scales, 4.0, &[0.5; 3]);
    }
    splats
}

#[test]
fn splats_become_a_mesh_or_a_clear_error() {
    let above: Vec<Camera> = cameras(40, 128).into_iter().take(12).collect();
    let mesh_of = |splats: Splats, memory_bytes: u64| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.ply");
        ply::write(&path, &splats, &LocalFrame::WORLD).unwrap();
        let source =
            MeshSource { model: path, frame: &LocalFrame::WORLD, cameras: &above, max_size_px: Some(100) };
        mesh_file(&source, &settings(None, memory_bytes), 2, |_| GO)
    };
    let mesh = mesh_of(wall(), 200 << 20).unwrap().mesh;
    let (_, mean) = offsets(&mesh, |p| p.z);
    assert!(mean < 0.05, "{mean}");
    assert!(matches!(mesh_of(Splats::default(), 200 << 20), Err(MeshError::NoSurface)));
    let text = mesh_of(wall(), 1 << 20).unwrap_err().to_string();
    assert!(text.contains("1.00 MiB") && text.contains("--memory"), "{text}");
}

#[test]
fn the_mesh_is_the_same_in_many_parts() {
    let cameras = cameras(60, 160);
    let fused = |memory_bytes: u64| {
        let look = |camera: &Camera| look(cuboid, camera);
        fuse(&cameras, look, &settings(Some(BOX_VOXEL_M), memory_bytes), |_| GO).unwrap()
    };
    let whole = fused(1 << 30);
    assert_eq!(whole.parts, 1);
    let mut parts = Vec::new();
    for memory_bytes in [whole.peak_bytes * 3 / 4, whole.peak_bytes / 2] {
        let divided = fused(memory_bytes);
        assert!(divided.mesh == whole.mesh, "{} parts", divided.parts);
        assert!(divided.peak_bytes <= memory_bytes, "{} of {memory_bytes}", divided.peak_bytes);
        parts.push(divided.parts);
    }
    assert!(parts[0] > 1 && parts[1] > parts[0], "{parts:?}");
}

/// Goal: a mesh that grows in files has the same bytes as one in memory, and keeps its voxels with less memory. Method: a box with
/// plenty of memory; then with so little that the blocks are fused, and the file written, in several parts.
#[test]
fn a_mesh_that_grows_in_files_is_the_same_in_less_memory() {
    let cameras = cameras(60, 160);
    let look = |camera: &Camera| look(cuboid, camera);
    let fused =
        |memory_bytes| fuse(&cameras, look, &settings(Some(BOX_VOXEL_M), memory_bytes), |_| GO).unwrap();
    let whole = fused(1 << 30);
    let little_bytes = budget::frame_bytes(&cameras) + 1000 * whole.blocks as u64;
    assert!(fused(little_bytes).voxel_m > BOX_VOXEL_M);
    let folder = tempfile::tempdir().unwrap();
    let [path, wanted] = ["mesh.ply", "wanted.ply"].map(|name| folder.path().join(name));
    let frame = LocalFrame::of(cameras.iter());
    whole.clone().out_of_frame(&frame).mesh.write_ply(&wanted).unwrap();
    for (memory_bytes, is_in_parts) in [(1 << 30, false), (little_bytes, true)] {
        let (mut parts, settings) = (0, settings(Some(BOX_VOXEL_M), memory_bytes));
        let mut files = files::InFiles::new(&path, &frame).unwrap();
        let fused = fuse::fuse_into(&mut files, &cameras, look, &settings, |event| {
            parts += usize::from(matches!(event, FuseEvent::Progress { stage: Stage::Write, .. }));
            GO
        });
        let fused = fused.unwrap();
        assert!(std::fs::read(&path).unwrap() == std::fs::read(&wanted).unwrap(), "{memory_bytes} bytes");
        assert_eq!((fused.voxel_m, fused.mesh.triangles), (BOX_VOXEL_M, whole.mesh.triangles.len() as u64));
        assert!(fused.peak_bytes <= memory_bytes, "{} of {memory_bytes}", fused.peak_bytes);
        assert_eq!([fused.parts > 1, parts > 1], [is_in_parts; 2], "{} and {parts} parts", fused.parts);
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "nothing is left beside the meshes");
}

#[test]
fn a_mesh_that_is_not_finished_leaves_the_file_that_was_there() {
    let cameras = cameras(30, 96);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mesh.ply");
    std::fs::write(&path, "before").unwrap();
    let mut files = files::InFiles::new(&path, &LocalFrame::WORLD).unwrap();
    let stopped = fuse::fuse_into(
        &mut files,
        &cameras,
        |camera: &Camera| look(sphere, camera),
        &settings(Some(0.1), 1 << 28),
        |event| match event {
            FuseEvent::Progress { stage: Stage::Write, .. } => ControlFlow::Break(()),
            _ => GO,
        },
    );
    assert!(matches!(stopped, Err(MeshError::Stopped)));
    assert_eq!(std::fs::read(&path).unwrap(), b"before");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
