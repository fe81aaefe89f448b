//! Tests of the city's promises. They compute rays and distances independently of the tested code: by
//! brute force over all triangles, in double precision.

#![allow(clippy::unwrap_used)]

mod oracle;

use std::sync::OnceLock;

use glam::{DVec2, DVec3, Vec3};

use cosurf_scene::bvh::{Bvh, Hit, Ray};
use oracle::{brute_force, distance_to_surface};

use super::appearance::Appearance;
use super::light::Lit;
use super::random::Rng;
use super::{City, CityError, CitySettings};
use cosurf_scene::{Camera, Dataset};

const SMALL: CitySettings = CitySettings { seed: 3, extent_m: 30.0, views: 8, size_px: [64, 48] };

/// A small city that the read-only tests share.
fn small() -> &'static City {
    static CITY: OnceLock<City> = OnceLock::new();
    CITY.get_or_init(|| City::build(&SMALL).unwrap())
}

/// The 64-bit FNV-1a hash.
fn hash(bytes: impl IntoIterator<Item = u8>) -> u64 {
    bytes.into_iter().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3))
}

/// The fingerprint of [`SMALL`], recorded on x86-64; every machine must give the same.
const FINGERPRINT: [u64; 4] =
    [0x40ea_4a9a_a31e_3978, 0x8856_b155_cb29_109c, 0xb6ae_638e_5895_eab7, 0x6aa5_87e6_7612_4a05];

/// Hashes of a picture, its depth and normals, the sparse cloud and the truth.
fn fingerprint(city: &City) -> [u64; 4] {
    let frame = city.render(&city.cameras()[5]);
    let depth = frame.depth.iter().flat_map(|d| d.to_le_bytes());
    let normals = frame.normals.iter().flatten().flat_map(|n| n.to_le_bytes());
    let cloud = city.dataset().points;
    let cloud = cloud.iter().flat_map(|p| p.position.to_array()).flat_map(|x| x.to_le_bytes());
    let truth = city.truth_points(500, 1);
    let truth = truth.iter().flat_map(|p| p.position).flat_map(f32::to_le_bytes);
    [hash(frame.picture.rgb), hash(depth.chain(normals)), hash(cloud), hash(truth)]
}

fn with_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

#[test]
fn the_same_settings_give_the_same_bytes_with_any_number_of_threads() {
    let one = with_threads(1, || fingerprint(&City::build(&SMALL).unwrap()));
    let two = with_threads(2, || fingerprint(&City::build(&SMALL).unwrap()));
    assert_eq!(one, two);
    assert_eq!(
        one, FINGERPRINT,
        "this machine builds another city, or the city was changed; update the constant only for a change"
    );
    let other = City::build(&CitySettings { seed: 4, ..SMALL }).unwrap();
    assert!(fingerprint(&other).iter().zip(one).all(|(a, b)| *a != b), "another seed must give another city");
}

fn corners(city: &City) -> Vec<[DVec3; 3]> {
    city.world.mesh.triangles.iter().map(|t| t.corners.map(|p| p.as_dvec3())).collect()
}

#[test]
fn depth_and_normals_are_those_of_the_mesh() {
    let city = small();
    let triangles = corners(city);
    let mut rng = Rng::new(1, 1);
    let mut checked = 0;
    for camera in [&city.cameras()[0], &city.cameras()[6]] {
        let frame = city.render(camera);
        let center = camera.cam_from_world.center();
        for _ in 0..20 {
            let (x, y) = (rng.index(64), rng.index(48));
            let ray = camera.ray(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            let direction = camera.cam_from_world.rotation.inverse() * ray;
            let (depth, normal) = brute_force(&triangles, center, direction).unwrap();
            let traced = f64::from(frame.depth[y * 64 + x]);
            // A ray through an edge may hit either side of it.
            if (traced - depth).abs() < 1e-4 * depth {
                let normal = (camera.cam_from_world.rotation * normal).as_vec3();
                let agree = Vec3::from(frame.normals[y * 64 + x]).dot(normal);
                checked += usize::from((agree - 1.0).abs() < 1e-4 && agree <= 1.0 + 1e-5);
            }
        }
    }
    assert!(checked >= 39, "{checked} of 40 pixels agree");
}

#[test]
fn the_hierarchy_finds_what_brute_force_finds() {
    let mut rng = Rng::new(2, 2);
    let point = |rng: &mut Rng| Vec3::new(rng.signed(), rng.signed(), rng.signed());
    for count in [0, 1, 2, 5, 300] {
        let triangles: Vec<[Vec3; 3]> = (0..count)
            .map(|i| {
                let (a, size) = (point(&mut rng), if i % 3 == 0 { 1.0 } else { 0.2 });
                // Some are degenerate, some lie in a plane across an axis.
                let b = if i % 17 == 5 { a } else { a + point(&mut rng) * size };
                let c = a + point(&mut rng) * size;
                if i % 5 == 0 { [a, b.with_z(a.z), c.with_z(a.z)] } else { [a, b, c] }
            })
            .collect();
        let bvh = Bvh::build(&triangles);
        let exact: Vec<[DVec3; 3]> = triangles.iter().map(|t| t.map(|p| p.as_dvec3())).collect();
        let mut met = 0;
        for i in 0..400 {
            let origin = point(&mut rng) * 2.0;
            let axis = [Vec3::X, Vec3::NEG_Y, Vec3::NEG_Z][i % 3];
            let direction = if i % 4 == 0 { axis } else { point(&mut rng) };
            let ray = Ray { origin, direction, t_min: 0.0, t_max: f32::INFINITY };
            let [found] = bvh.nearest(&[ray]);
            let expected = brute_force(&exact, origin.as_dvec3(), direction.as_dvec3());
            assert_eq!(found.is_some(), expected.is_some(), "ray {i} of {count} triangles");
            assert_eq!(bvh.blocked(&[ray]), [expected.is_some()]);
            if let (Some(Hit { t, .. }), Some((depth, _))) = (found, expected) {
                met += 1;
                assert!((f64::from(t) - depth).abs() < 1e-4 * depth.max(1.0), "{t} {depth}");
                assert!(
                    !bvh.blocked(&[Ray { t_max: 0.999 * t, ..ray }])[0],
                    "nothing may block the ray before its nearest hit"
                );
            }
        }
        assert!(count < 300 || met > 100, "{met} rays hit a triangle");
    }
}

#[test]
fn a_bundle_of_rays_finds_what_each_ray_finds_alone() {
    let world = &small().world;
    let mut rng = Rng::new(3, 3);
    let mut met = 0;
    for i in 0..300 {
        // Rays from one point in similar directions, or from neighbouring points in one direction. Some go
        // straight down, or both ways along an axis.
        let spread = [0.0, 0.01, 0.3][i % 3];
        let mut jitter = || Vec3::new(rng.signed(), rng.signed(), rng.signed()) * spread;
        let steep = if i % 5 == 0 { Vec3::NEG_Z } else { Vec3::new(0.4, -0.2, -1.0) };
        let from = Vec3::new(-25.0, 20.0, 55.0) + jitter() * 40.0;
        let rays = [(); 5].map(|()| {
            let (origin, direction) =
                if i % 2 == 0 { (from, steep + jitter()) } else { (from + jitter() * 4.0, steep) };
            Ray { origin, direction, t_min: 0.0, t_max: f32::INFINITY }
        });
        let together = world.bvh.nearest(&rays);
        let blocked = world.bvh.blocked(&rays);
        for k in 0..5 {
            let [alone] = world.bvh.nearest(&[rays[k]]);
            assert_eq!(together[k].map(|hit| hit.t), alone.map(|hit| hit.t), "ray {k} of bundle {i}");
            assert_eq!(blocked[k], alone.is_some());
            met += usize::from(alone.is_some());
        }
    }
    assert!(met > 1000, "{met} rays hit a triangle");
}

#[test]
fn sparse_points_lie_on_the_surface_except_for_outliers() {
    // In large pictures the noise is small in metres, so points far off the surface are outliers.
    let city = City::build(&CitySettings { views: 16, size_px: [1200, 900], ..SMALL }).unwrap();
    let cloud = city.dataset();
    let triangles = corners(&city);
    let focal_px = cloud.views[0].camera.focal_px.x;
    let (mut distances_m, mut errors_px) = (Vec::new(), Vec::new());
    for point in &cloud.points {
        assert!(point.views.len() >= 3 && point.views.is_sorted_by(|a, b| a < b), "{:?}", point.views);
        assert!(point.views.iter().all(|&view| (view as usize) < cloud.views.len()));
    }
    for point in cloud.points.iter().step_by(cloud.points.len() / 700) {
        let depth =
            |&view: &u32| cloud.views[view as usize].camera.cam_from_world.transform(point.position).z;
        let pixel_m = point.views.iter().map(depth).sum::<f64>() / point.views.len() as f64 / focal_px;
        let distance_m = distance_to_surface(&triangles, point.position);
        distances_m.push(distance_m);
        errors_px.push(distance_m / pixel_m);
    }
    let share = |of: &[f64], limit: f64| of.iter().filter(|&&x| x > limit).count() as f64 / of.len() as f64;
    let outliers = share(&distances_m, 1.5);
    assert!((0.008..0.06).contains(&outliers), "about 3 % must be outliers: {outliers}");
    errors_px.sort_by(f64::total_cmp);
    let median_px = errors_px[errors_px.len() / 2];
    assert!((0.1..0.7).contains(&median_px), "the noise must be below a pixel: {median_px}");
    assert!(share(&errors_px, 3.0) < 0.1, "most errors must be below 3 px: {}", share(&errors_px, 3.0));
}

#[test]
fn tracks_name_cameras_that_see_the_point() {
    let city = City::build(&CitySettings { size_px: [320, 240], ..SMALL }).unwrap();
    let triangles = corners(&city);
    let mut agree = (0, 0);
    for point in city.dataset().points.iter().step_by(9) {
        for &view in &point.views {
            let center = city.cameras()[view as usize].cam_from_world.center();
            let line = point.position - center;
            // An outlier or a noisy point may lie behind the surface, so agreements are counted.
            let clear =
                brute_force(&triangles, center, line).is_none_or(|(t, _)| t > 1.0 - 1.5 / line.length());
            agree = (agree.0 + usize::from(clear), agree.1 + 1);
        }
    }
    assert!(agree.1 > 20 && 20 * agree.0 > 17 * agree.1, "{agree:?}");
}

#[test]
fn every_camera_sees_ground_in_nearly_all_pixels() {
    for settings in [SMALL, CitySettings { size_px: [48, 64], seed: 11, ..SMALL }] {
        let city = City::build(&settings).unwrap();
        for (i, camera) in city.cameras().iter().enumerate() {
            let frame = city.render(camera);
            let void = frame.depth.iter().filter(|d| **d == 0.0).count();
            assert!(100 * void <= frame.depth.len(), "view {i}: {void} pixels show nothing");
            let filled = frame.depth.iter().zip(&frame.normals);
            for (depth, normal) in filled.filter(|(d, _)| **d > 0.0) {
                assert!(*depth > 5.0 && *depth < 1000.0, "view {i} at {depth} m");
                assert!((Vec3::from(*normal).length() - 1.0).abs() < 1e-4);
            }
        }
    }
}

#[test]
fn void_is_black_and_empty() {
    let mut camera = small().cameras()[0];
    // A camera that looks up into the sky.
    camera.cam_from_world = cosurf_scene::Pose::look_at(DVec3::Z * 50.0, DVec3::Z * 90.0, DVec3::Y);
    let frame = small().render(&camera);
    assert!(frame.picture.rgb.iter().all(|&byte| byte == 0));
    assert!(frame.depth.iter().all(|&d| d == 0.0) && frame.normals.iter().all(|&n| n == [0.0; 3]));
}

#[test]
fn pictures_have_contrast_and_change_with_the_view() {
    let city = small();
    let frame = city.render(&city.cameras()[1]);
    let luma = |c: &[u8]| c.iter().map(|&b| f64::from(b)).sum::<f64>() / 3.0;
    let values: Vec<f64> = frame.picture.rgb.chunks_exact(3).map(luma).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt();
    assert!((50.0..190.0).contains(&mean) && deviation > 20.0, "mean {mean}, deviation {deviation}");
}

#[test]
fn glossy_surfaces_depend_on_the_view_and_matt_ones_do_not() {
    let light = &small().world.light;
    let seen = |to_viewer: Vec3, appearance: &Appearance| {
        let lit = Lit { position: Vec3::Z * 40.0, normal: Vec3::Z, to_viewer: to_viewer.normalize() };
        light.radiance(&lit, appearance, true)
    };
    let (steep, flat) = (Vec3::new(0.1, 0.0, 1.0), Vec3::new(0.9, 0.3, 0.4));
    let difference =
        |appearance: &Appearance| (seen(steep, appearance) - seen(flat, appearance)).abs().max_element();
    assert_eq!(difference(&Appearance::matt(Vec3::splat(0.2))), 0.0);
    assert!(difference(&Appearance::glossy(Vec3::splat(0.02), 0.1)) > 0.03);
}

#[test]
fn any_size_can_be_built() {
    let tiny = CitySettings { seed: 5, extent_m: 10.0, views: 3, size_px: [16, 16] };
    let large = CitySettings { seed: 6, extent_m: 150.0, views: 5, size_px: [20, 16] };
    for settings in [tiny, large] {
        let city = City::build(&settings).unwrap();
        assert_eq!(city.cameras().len(), settings.views as usize);
        assert!(city.triangle_count() > 10_000);
        city.render(&city.cameras()[1]);
        assert_eq!(city.dataset().views.len(), settings.views as usize);
    }
}

#[test]
fn impossible_settings_are_refused() {
    for extent_m in [0.0, -5.0, 9.9, 1000.1, f64::NAN, f64::INFINITY] {
        let error = City::build(&CitySettings { extent_m, ..SMALL }).unwrap_err();
        assert!(matches!(error, CityError::Extent(_)), "{error}");
    }
    for views in [0, 2, 10_000] {
        let error = City::build(&CitySettings { views, ..SMALL }).unwrap_err();
        assert_eq!(error, CityError::Views(views));
        assert!(error.to_string().contains(&views.to_string()));
    }
    for size_px in [[0, 10], [100, 8193], [15, 16]] {
        assert_eq!(City::build(&CitySettings { size_px, ..SMALL }).unwrap_err(), CityError::Size(size_px));
    }
}

#[test]
fn the_principal_point_is_off_centre_and_names_sort_in_flight_order() {
    let dataset = small().dataset();
    let camera = dataset.views[0].camera;
    assert!((camera.center_px - DVec2::new(32.0, 24.0)).abs().min_element() > 0.5);
    let names: Vec<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names[..2], ["0000.jpg", "0001.jpg"]);
    assert!(names.is_sorted());
    let down = |camera: &Camera| -camera.cam_from_world.forward().z;
    assert!(dataset.views[..4].iter().all(|view| down(&view.camera) > 0.97), "the first half must look down");
    assert!(dataset.views[4..].iter().all(|view| (0.5..0.9).contains(&down(&view.camera))));
}

#[test]
fn truth_points_cover_the_seen_surface_evenly() {
    let city = small();
    let triangles = corners(city);
    let mesh = city.truth_mesh();
    assert_eq!(mesh.positions.len(), mesh.rgb.len());
    let corner = |i: u32| DVec3::from(mesh.positions[i as usize].map(f64::from));
    let area = |t: &[u32; 3]| {
        let [a, b, c] = t.map(corner);
        0.5 * (b - a).cross(c - a).length()
    };
    let total: f64 = mesh.triangles.iter().map(area).sum();
    let east = |x: f64| x > 0.0;
    let eastern: f64 =
        mesh.triangles.iter().filter(|t| east(t.map(corner).iter().map(|p| p.x).sum())).map(area).sum();
    let points = city.truth_points(4000, 9);
    assert_eq!(points.len(), 4000);
    let mut places: Vec<[u32; 3]> = points.iter().map(|p| p.position.map(f32::to_bits)).collect();
    places.sort_unstable();
    assert!(places.windows(2).all(|pair| pair[0] != pair[1]), "no two points may coincide");
    let share = points.iter().filter(|p| east(f64::from(p.position[0]))).count() as f64 / 4000.0;
    assert!((share - eastern / total).abs() < 0.04, "{share} {}", eastern / total);
    for point in points.iter().step_by(100) {
        let p = DVec3::from(point.position.map(f64::from));
        assert!(distance_to_surface(&triangles, p) < 1e-3);
        let seen = city.cameras().iter().filter(|camera| {
            let line = p - camera.cam_from_world.center();
            let first = brute_force(&triangles, camera.cam_from_world.center(), line);
            camera.project(p).is_some_and(|px| camera.contains(px))
                && first.is_none_or(|(t, _)| t > 1.0 - 0.05 / line.length())
        });
        assert!(seen.count() >= 3, "{p}");
    }
}

/// Models are evaluated against the true mesh, so its depth must equal that of the city's renderings. It is never
/// nearer, and it is farther only through holes, where fewer than three cameras see the surface.
#[test]
fn the_true_mesh_has_the_depth_of_the_renderings() {
    let caster = cosurf_scene::Caster::new(&small().truth_mesh());
    let (mut met, mut nearer, mut farther) = (0, 0, 0);
    for camera in small().cameras() {
        let (frame, cast) = (small().render(camera), caster.cast(camera));
        for (exact, depth) in frame.depth.iter().zip(&cast.depth).filter(|(_, depth)| **depth > 0.0) {
            met += 1;
            nearer += usize::from(*depth < 0.999 * exact);
            farther += usize::from(*depth > 1.001 * exact);
        }
    }
    assert!(met > 15_000 && nearer == 0 && 20 * farther < met, "{nearer} and {farther} of {met}");
}

#[test]
fn a_written_city_opens_as_a_dataset() {
    let folder = tempfile::tempdir().unwrap();
    let mut done = Vec::new();
    let written = small().write(folder.path(), |i, of| done.push((i, of))).unwrap();
    assert_eq!((done.len(), done[7]), (8, (8, 8)));
    let opened = Dataset::open(folder.path()).unwrap();
    assert_eq!(opened.views.len(), 8);
    for (a, b) in written.views.iter().zip(&opened.views) {
        assert_eq!((&a.name, a.camera.center_px, &a.path), (&b.name, b.camera.center_px, &b.path));
        let p = DVec3::new(3.0, 4.0, 1.0);
        assert!(a.camera.project(p).unwrap().distance(b.camera.project(p).unwrap()) < 1e-9);
    }
    assert_eq!(written.points.len(), opened.points.len());
    let truth = cosurf_scene::ply::read_points(&folder.path().join("gt/points.ply")).unwrap();
    assert_eq!(truth.len(), 20_000);
    let mesh = cosurf_scene::Mesh::read(&folder.path().join("gt/mesh.ply")).unwrap();
    assert!(mesh == small().truth_mesh(), "the mesh must survive writing and reading");
}
