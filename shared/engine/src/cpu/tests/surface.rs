//! Compares the surface losses with a direct f64 implementation. Gradients with respect to blended normals and
//! distances are compared with central differences at every third pixel. The engine holds some values constant: the
//! weights `exp(-e)` for reprojection errors `e`, and which pixels count. In the differences, these values are those of
//! the unchanged picture.

use cosurf_scene::picture::MASKED;
use cosurf_scene::{Camera, Pose};
use glam::{DMat3, DVec2, DVec3};

use super::super::surface::Surface;
use crate::backend::{
    MultiviewWeights, PatchSide, SurfaceLoss, SurfaceWeights, TargetRgb, TargetSurface, Targets, TeacherLoss,
    TeacherWeights,
};
use crate::layout::constants::NORMAL_REACH;
use crate::layout::planes::{DISTANCE, NORMAL, PLANES_GEOMETRY, TRANSMITTANCE};
use crate::layout::tiles::TileImage;
use crate::layout::view::ViewParams;
use crate::random::{Purpose, Random};
use crate::simd::{Isa, Row};

const MULTIVIEW: MultiviewWeights =
    MultiviewWeights { reprojection: 0.4, ncc: 1.3, cell_px: 1, patch: PatchSide::Px3, draw: 5 };
const WEIGHTS: SurfaceWeights = weights(PatchSide::Px3);

/// The weights with patches of this side.
const fn weights(patch: PatchSide) -> SurfaceWeights {
    SurfaceWeights { normal: 0.7, multiview: Some(MultiviewWeights { patch, ..MULTIVIEW }) }
}

/// Direction of the normal of the ground, which is the plane `PLANE · X = LEVEL` in the world.
const PLANE: DVec3 = DVec3::new(0.05, -0.08, 1.0);
const LEVEL: f64 = 0.3;

/// Blended normals, plane distances and transmittances of a picture, row by row.
#[derive(Clone)]
struct Blend {
    camera: Camera,
    normal: Vec<DVec3>,
    distance: Vec<f64>,
    transmittance: Vec<f64>,
}

fn camera(eye: DVec3) -> Camera {
    Camera {
        cam_from_world: Pose::look_at(eye, DVec3::new(0.3, 0.1, 0.2), DVec3::new(0.1, 1.0, 0.3)),
        focal_px: DVec2::new(38.0, 41.0),
        center_px: DVec2::new(17.0, 15.2),
        size_px: [37, 34],
    }
}

fn cameras() -> [Camera; 2] {
    [camera(DVec3::new(0.4, -0.6, 7.0)), camera(DVec3::new(1.3, 0.2, 6.6))]
}

fn width(camera: &Camera) -> usize {
    camera.size_px[0] as usize
}

fn pixels(camera: &Camera) -> usize {
    (camera.size_px[0] * camera.size_px[1]) as usize
}

fn ray(camera: &Camera, x: f64, y: f64) -> DVec3 {
    camera.ray(DVec2::new(x + 0.5, y + 0.5))
}

/// The plane of the ground in a camera's frame: the unit normal that faces the camera, and the distance from the camera
/// centre.
fn ground(camera: &Camera) -> (DVec3, f64) {
    let normal = PLANE.normalize();
    let height = normal.dot(camera.cam_from_world.center()) - LEVEL / PLANE.length();
    (camera.cam_from_world.rotation * normal, height)
}

/// The ground as splats might render it: with noise, and not fully opaque.
fn blend(camera: Camera, roughness: f32, seed: u64) -> Blend {
    let mut random = Random::new(seed, Purpose::Test, 0, 0);
    let (n, d) = ground(&camera);
    let mut blend = Blend { camera, normal: Vec::new(), distance: Vec::new(), transmittance: Vec::new() };
    for _ in 0..pixels(&camera) {
        let mut noise = || f64::from(roughness * random.normal());
        let alpha = 0.93 + 0.5 * noise().clamp(-0.1, 0.1);
        // Rounded to f32, so that both implementations get the same numbers.
        let exact = |v: f64| f64::from(v as f32);
        let bent = n + DVec3::new(noise(), noise(), noise());
        blend.normal.push((alpha * bent).to_array().map(exact).into());
        blend.distance.push(exact(alpha * d * (1.0 + 0.1 * noise())));
        blend.transmittance.push(exact(1.0 - alpha));
    }
    blend
}

/// Brightness of the ground at a point.
fn paint(p: DVec3) -> f32 {
    let waves = (2.1 * p.x + 0.4).sin() * (1.7 * p.y).cos() + 0.6 * (1.3 * p.x - 2.9 * p.y).sin();
    (0.5 + 0.22 * waves) as f32
}

fn photograph(camera: &Camera) -> Vec<f32> {
    let (n, d) = ground(camera);
    let world_from_cam = camera.cam_from_world.rotation.inverse();
    (0..pixels(camera))
        .flat_map(|i| {
            let r = ray(camera, (i % width(camera)) as f64, (i / width(camera)) as f64);
            let point = camera.cam_from_world.center() + world_from_cam * (r * (d / -n.dot(r)));
            [paint(point); 3]
        })
        .collect()
}

fn tiles(blend: &Blend) -> TileImage {
    let mut image = TileImage::with_capacity(0, PLANES_GEOMETRY);
    image.reshape(blend.camera.size_px, PLANES_GEOMETRY);
    for i in 0..pixels(&blend.camera) {
        let (x, y) = (i % width(&blend.camera), i / width(&blend.camera));
        for axis in 0..3 {
            image.set_value(NORMAL + axis, x, y, blend.normal[i][axis] as f32);
        }
        image.set_value(DISTANCE, x, y, blend.distance[i] as f32);
        image.set_value(TRANSMITTANCE, x, y, blend.transmittance[i] as f32);
    }
    image
}

/// The losses and gradients of the engine.
fn engine(isa: Isa, here: &Blend, there: &Blend, photographs: [&[f32]; 2]) -> (SurfaceLoss, TileImage) {
    engine_on(isa, here, there, photographs.map(TargetRgb::Floats), &WEIGHTS)
}

fn engine_on(
    isa: Isa,
    here: &Blend,
    there: &Blend,
    photographs: [TargetRgb; 2],
    weights: &SurfaceWeights,
) -> (SurfaceLoss, TileImage) {
    let mut surface = Surface::with_capacity(here.camera.size_px, 2);
    surface.keep_neighbour(isa, &tiles(there), &ViewParams::new(&there.camera, 0));
    let image = tiles(here);
    let mut gradient = image.clone();
    gradient.rows_mut().fill(Row([f32::NAN; 16]));
    let targets = Targets { neighbour_rgb: Some(photographs[1]), ..Targets::colors(photographs[0]) };
    let view = ViewParams::new(&here.camera, 0);
    let loss = surface.losses(isa, &image, &view, &targets, weights, &mut gradient);
    (loss, gradient)
}

/// For each pixel of the unchanged picture: the weight `exp(-e)` and whether its patch counts. `None` if the
/// reprojection error `e` is 1 px or more, or the pixel has no match in the neighbouring view.
type Decisions = Vec<Option<(f64, bool)>>;

/// A picture with one number per pixel, row by row, with bilinear interpolation.
struct Map {
    size: [usize; 2],
    values: Vec<f64>,
}

impl Map {
    fn sample(&self, q: DVec2) -> Option<f64> {
        let (u, v) = (q.x - 0.5, q.y - 0.5);
        if u < 0.0 || v < 0.0 || u >= (self.size[0] - 1) as f64 || v >= (self.size[1] - 1) as f64 {
            return None;
        }
        let (x, y) = (u as usize, v as usize);
        let (a, b) = (u.fract(), v.fract());
        let at = |x: usize, y: usize| self.values[y * self.size[0] + x];
        Some(
            (1.0 - b) * ((1.0 - a) * at(x, y) + a * at(x + 1, y))
                + b * ((1.0 - a) * at(x, y + 1) + a * at(x + 1, y + 1)),
        )
    }
}

fn depths(blend: &Blend) -> Vec<f64> {
    (0..pixels(&blend.camera))
        .map(|i| {
            let r = ray(&blend.camera, (i % width(&blend.camera)) as f64, (i / width(&blend.camera)) as f64);
            blend.distance[i] / -blend.normal[i].dot(r)
        })
        .collect()
}

struct Reference {
    neighbour: Camera,
    neighbour_depth: Map,
    luma: [Map; 2],
    /// Number of pixels of a patch on each side of its centre.
    reach: usize,
}

impl Reference {
    fn new(there: &Blend, photographs: [&[f32]; 2], reach: usize) -> Self {
        let size = there.camera.size_px.map(|side| side as usize);
        let map = |values: Vec<f64>| Map { size, values };
        let luma = |rgb: &[f32]| map(rgb.chunks_exact(3).map(|p| f64::from(p[0])).collect());
        let (neighbour_depth, luma) = (map(depths(there)), photographs.map(luma));
        Self { neighbour: there.camera, neighbour_depth, luma, reach }
    }

    fn normal(&self, here: &Blend) -> f64 {
        let (camera, z) = (&here.camera, depths(here));
        let [w, h] = camera.size_px.map(|side| side as usize);
        let luma = |x: usize, y: usize| self.luma[0].values[y * w + x];
        let inner: Vec<(usize, usize)> = (1..h - 1).flat_map(|y| (1..w - 1).map(move |x| (x, y))).collect();
        let slope = |(x, y): (usize, usize)| {
            (luma(x + 1, y) - luma(x - 1, y)).abs().max((luma(x, y - 1) - luma(x, y + 1)).abs())
        };
        let slopes: Vec<f64> = inner.iter().map(|p| slope(*p)).collect();
        let least = slopes.iter().copied().fold(f64::INFINITY, f64::min);
        let most = slopes.iter().copied().fold(0.0, f64::max);
        let k = NORMAL_REACH;
        let sum: f64 = inner
            .iter()
            .zip(slopes)
            .filter(|((x, y), _)| (k..w - k).contains(x) && (k..h - k).contains(y))
            .map(|(&(x, y), slope)| {
                let point = |x: usize, y: usize| z[y * w + x] * ray(camera, x as f64, y as f64);
                let across = point(x + k, y) - point(x - k, y);
                let up = point(x, y - k) - point(x, y + k);
                let i = y * w + x;
                let off = (1.0 - here.transmittance[i]) * across.cross(up).normalize() - here.normal[i];
                (1.0 - (slope - least) / (most - least)).powi(2) * off.abs().element_sum()
            })
            .sum();
        sum / (w * h) as f64
    }

    /// Rotation and translation of `neighbour_from_here`.
    fn way(&self, here: &Camera) -> (DMat3, DVec3) {
        let (a, b) = (here.cam_from_world, self.neighbour.cam_from_world);
        let rotation = DMat3::from_quat(b.rotation) * DMat3::from_quat(a.rotation).transpose();
        (rotation, b.translation - rotation * a.translation)
    }

    fn reprojection_error(&self, camera: &Camera, x: usize, y: usize, z: f64) -> Option<f64> {
        let (rotation, translation) = self.way(camera);
        let project = |camera: &Camera, p: DVec3| camera.focal_px * p.truncate() / p.z + camera.center_px;
        let there = project(&self.neighbour, rotation * (z * ray(camera, x as f64, y as f64)) + translation);
        let hit = self.neighbour_depth.sample(there)? * self.neighbour.ray(there);
        let back = project(camera, rotation.transpose() * (hit - translation));
        Some(back.distance(DVec2::new(x as f64 + 0.5, y as f64 + 0.5)))
    }

    /// `(1 - NCC², covariance)` of the patch around a pixel, with the homography as a matrix. `None` if a patch leaves
    /// its picture.
    fn disagreement(&self, here: &Blend, x: usize, y: usize) -> Option<(f64, f64)> {
        let camera = &here.camera;
        let [w, h] = camera.size_px.map(|side| side as usize);
        let reach = self.reach;
        if x < reach || y < reach || x + reach >= w || y + reach >= h {
            return None;
        }
        let (rotation, t) = self.way(camera);
        let m = here.normal[y * w + x] / here.distance[y * w + x];
        // Points X of the plane satisfy -(m · X) = 1, so R X + t = (R - t mᵀ) X.
        let homography = rotation - DMat3::from_cols(t * m.x, t * m.y, t * m.z);
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for py in y - reach..=y + reach {
            for px in x - reach..=x + reach {
                let p = homography * ray(camera, px as f64, py as f64);
                let q = self.neighbour.focal_px * p.truncate() / p.z + self.neighbour.center_px;
                a.push(self.luma[0].values[py * w + px]);
                b.push(self.luma[1].sample(q)?);
            }
        }
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
        let (ma, mb) = (mean(&a), mean(&b));
        let moment = |u: &[f64], mu: f64, v: &[f64], mv: f64| {
            u.iter().zip(v).map(|(u, v)| (u - mu) * (v - mv)).sum::<f64>() / u.len() as f64
        };
        let covariance = moment(&a, ma, &b, mb);
        let both = moment(&a, ma, &a, ma) * moment(&b, mb, &b, mb);
        Some((1.0 - covariance * covariance / (both + 1e-8), covariance))
    }

    fn decide(&self, here: &Blend) -> Decisions {
        let z = depths(here);
        let w = width(&here.camera);
        (0..z.len())
            .map(|i| {
                let e = self.reprojection_error(&here.camera, i % w, i / w, z[i])?;
                let patch = self.disagreement(here, i % w, i / w);
                let counts = patch.is_some_and(|(value, covariance)| covariance > 0.0 && value < 0.9);
                (e < 1.0).then_some(((-e).exp(), counts))
            })
            .collect()
    }

    fn losses(&self, here: &Blend, decisions: &Decisions) -> [f64; 3] {
        let z = depths(here);
        let w = width(&here.camera);
        let (mut reprojection, mut ncc) = (0.0, 0.0);
        for (i, decision) in decisions.iter().enumerate() {
            let Some((trust, counts)) = decision else { continue };
            let e = self.reprojection_error(&here.camera, i % w, i / w, z[i]);
            reprojection += trust * e.expect("a small step does not leave the picture");
            if *counts {
                let patch = self.disagreement(here, i % w, i / w);
                ncc += trust * patch.expect("a small step does not leave the picture").0;
            }
        }
        let n = z.len() as f64;
        [self.normal(here), reprojection / n, ncc / n]
    }

    fn total(&self, here: &Blend, decisions: &Decisions) -> f64 {
        let [normal, reprojection, ncc] = self.losses(here, decisions);
        f64::from(WEIGHTS.normal) * normal
            + f64::from(MULTIVIEW.reprojection) * reprojection
            + f64::from(MULTIVIEW.ncc) * ncc
    }
}

/// The value of `plane` at pixel `i`: an axis of the normal, or the distance.
fn number(blend: &mut Blend, plane: usize, i: usize) -> &mut f64 {
    match plane {
        DISTANCE => &mut blend.distance[i],
        _ => &mut blend.normal[i][plane - NORMAL],
    }
}

/// The largest relative error and its description. Errors are relative to the expected number, or to a tenth of the
/// root mean square of its plane if that is larger.
fn worst(gradient: &TileImage, numeric: &[(usize, usize, f64)], w: usize) -> (f64, String) {
    let mut worst = (0.0, String::new());
    for plane in [NORMAL, NORMAL + 1, NORMAL + 2, DISTANCE] {
        let of_plane: Vec<_> = numeric.iter().filter(|(p, ..)| *p == plane).collect();
        let rms = (of_plane.iter().map(|(.., v)| v * v).sum::<f64>() / of_plane.len() as f64).sqrt();
        for &&(_, i, expected) in &of_plane {
            let value = f64::from(gradient.value(plane, i % w, i / w));
            let error = (value - expected).abs() / expected.abs().max(0.1 * rms);
            if error.is_nan() || error > worst.0 {
                worst = (error, format!("plane {plane}, pixel {i}: {value} is not {expected}"));
            }
        }
    }
    worst
}

#[test]
fn surface_losses_and_gradients_agree_with_the_definition() {
    agrees_with_the_definition(PatchSide::Px3, 1);
}

#[test]
fn losses_and_gradients_of_wide_patches_agree_with_the_definition() {
    agrees_with_the_definition(PatchSide::Px7, 3);
}

/// With patches that reach so many pixels from their centres.
fn agrees_with_the_definition(patch: PatchSide, reach: usize) {
    // With these seeds, no difference in the losses is so small that f32 loses its sign.
    let [here, there] = [blend(cameras()[0], 0.03, 3), blend(cameras()[1], 0.03, 2)];
    let photographs = cameras().map(|camera| photograph(&camera));
    let photographs = [photographs[0].as_slice(), photographs[1].as_slice()];
    let reference = Reference::new(&there, photographs, reach);
    let decisions = reference.decide(&here);
    let [normal, reprojection, ncc] = reference.losses(&here, &decisions);
    let n = decisions.len() as f64;
    let returned = decisions.iter().flatten().count() as f64 / n;
    let matched = decisions.iter().flatten().filter(|(_, counts)| *counts).count() as f64 / n;
    assert!(returned > 0.3 && matched > 0.2, "the case compares something: {returned} {matched}");

    let mut numeric = Vec::new();
    let mut moved = here.clone();
    for plane in [NORMAL, NORMAL + 1, NORMAL + 2, DISTANCE] {
        for i in (0..decisions.len()).step_by(3) {
            let before = *number(&mut moved, plane, i);
            let mut at = |v: f64| {
                *number(&mut moved, plane, i) = v;
                reference.total(&moved, &decisions)
            };
            let step = 1e-6;
            numeric.push((plane, i, (at(before + step) - at(before - step)) / (2.0 * step)));
            *number(&mut moved, plane, i) = before;
        }
    }
    let w = width(&here.camera);
    for isa in Isa::available() {
        let (loss, mut gradient) =
            engine_on(isa, &here, &there, photographs.map(TargetRgb::Floats), &weights(patch));
        for (got, expected) in [
            (loss.normal, normal),
            (loss.reprojection, reprojection),
            (loss.ncc, ncc),
            (loss.returned, returned),
            (loss.matched, matched),
        ] {
            assert!((got - expected).abs() < 2e-4 * expected, "{}: {got} is not {expected}", isa.name());
        }
        let (error, what) = worst(&gradient, &numeric, w);
        assert!(error < 1e-3, "{}: relative error {error:.2e} at {what}", isa.name());
        // The comparison must notice one number that is wrong by 1 %.
        let (plane, i, _) = *numeric.iter().max_by(|a, b| a.2.abs().total_cmp(&b.2.abs())).expect("numbers");
        let wrong = 1.01 * gradient.value(plane, i % w, i / w);
        gradient.set_value(plane, i % w, i / w, wrong);
        assert!(worst(&gradient, &numeric, w).0 > 1e-3, "a wrong gradient went unnoticed");
    }
}

#[test]
fn a_perfect_surface_has_no_loss_and_a_negative_does_not_match() {
    let [here, there] = cameras().map(|camera| blend(camera, 0.0, 1));
    let photographs = cameras().map(|camera| photograph(&camera));
    let negative: Vec<f32> = photographs[1].iter().map(|v| 1.0 - v).collect();
    let (loss, _) = engine(Isa::best(), &here, &there, [&photographs[0], &photographs[1]]);
    assert!(loss.returned > 0.5 && loss.matched > 0.4, "{loss:?}");
    // The remaining loss of the patches comes from interpolation between pixels.
    assert!(loss.normal < 1e-3 && loss.reprojection < 1e-3 && loss.ncc < 0.0105, "{loss:?}");
    let (loss, _) = engine(Isa::best(), &here, &there, [&photographs[0], &negative]);
    assert_eq!(loss.matched, 0.0, "a negative is not the same ground");
}

const TEACHER: TeacherWeights = TeacherWeights { depth: 0.6, normal: 0.9 };

/// A teacher's rendering of the ground: depths, normals and trust. Every fifth pixel has no depth.
fn teacher(camera: Camera) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let shown = blend(camera, 0.05, 7);
    let mut random = Random::new(8, Purpose::Test, 0, 0);
    let trust = (0..pixels(&camera)).map(|_| random.normal().clamp(0.0, 1.0)).collect();
    let mut depth: Vec<f32> = depths(&shown).into_iter().map(|z| z as f32).collect();
    depth.iter_mut().step_by(5).for_each(|z| *z = 0.0);
    (depth, shown.normal.iter().flat_map(|n| n.as_vec3().to_array()).collect(), trust)
}

/// The depth loss and the normal loss of a teacher, by their definition and without weights.
fn teacher_losses(here: &Blend, target: &TargetSurface) -> [f64; 2] {
    let n = pixels(&here.camera) as f64;
    let (mut depth, mut normal) = (0.0, 0.0);
    for (i, z) in depths(here).into_iter().enumerate() {
        let trust = f64::from(target.trust[i]);
        if target.depth[i] > 0.0 {
            depth += trust * (z - f64::from(target.depth[i])).abs();
        }
        let wanted = DVec3::from_array([0, 1, 2].map(|axis| f64::from(target.normal[3 * i + axis])));
        normal += trust * (here.normal[i] - wanted).abs().element_sum();
    }
    [depth / n, normal / n]
}

#[test]
fn a_teachers_losses_and_gradients_agree_with_the_definition() {
    let here = blend(cameras()[0], 0.03, 1);
    let (depth, normal, trust) = teacher(here.camera);
    let target = TargetSurface { depth: &depth, normal: &normal, trust: &trust };
    let total = |blend: &Blend| {
        let [depth, normal] = teacher_losses(blend, &target);
        f64::from(TEACHER.depth) * depth + f64::from(TEACHER.normal) * normal
    };
    let mut numeric = Vec::new();
    let mut moved = here.clone();
    for plane in [NORMAL, NORMAL + 1, NORMAL + 2, DISTANCE] {
        for i in (0..pixels(&here.camera)).step_by(3) {
            let before = *number(&mut moved, plane, i);
            let mut at = |v: f64| {
                *number(&mut moved, plane, i) = v;
                total(&moved)
            };
            let step = 1e-7;
            numeric.push((plane, i, (at(before + step) - at(before - step)) / (2.0 * step)));
            *number(&mut moved, plane, i) = before;
        }
    }
    let [wanted_depth, wanted_normal] = teacher_losses(&here, &target);
    assert!(wanted_depth > 1e-3 && wanted_normal > 1e-3, "the case compares something");
    for isa in Isa::available() {
        let image = tiles(&here);
        let view = ViewParams::new(&here.camera, 0);
        let mut surface = Surface::with_capacity(here.camera.size_px, 2);
        let mut gradient = image.clone();
        let none = SurfaceWeights { normal: 0.0, multiview: None };
        let photograph = photograph(&here.camera);
        let targets = Targets::colors(TargetRgb::Floats(&photograph));
        surface.losses(isa, &image, &view, &targets, &none, &mut gradient);
        let TeacherLoss { depth, normal } =
            surface.teach(isa, &image, &view, &target, &TEACHER, &mut gradient);
        assert!((depth - wanted_depth).abs() < 2e-4 * wanted_depth, "{}: {depth}", isa.name());
        assert!((normal - wanted_normal).abs() < 2e-4 * wanted_normal, "{}: {normal}", isa.name());
        let (error, what) = worst(&gradient, &numeric, width(&here.camera));
        assert!(error < 1e-3, "{}: relative error {error:.2e} at {what}", isa.name());
    }
}

#[test]
fn masked_pixels_of_view_and_neighbour_give_no_surface_loss() {
    let [here, there] = cameras();
    let (here, there) = (blend(here, 0.02, 1), blend(there, 0.02, 2));
    let bytes = |blend: &Blend, hidden: std::ops::Range<usize>| -> Vec<u8> {
        let mut rgb: Vec<u8> = photograph(&blend.camera).iter().map(|v| (255.0 * v) as u8).collect();
        let row = width(&blend.camera);
        let pixels = rgb.as_chunks_mut::<3>().0.iter_mut().enumerate();
        pixels.filter(|(i, _)| hidden.contains(&(i % row))).for_each(|(_, pixel)| *pixel = MASKED);
        rgb
    };
    let [plain, half, all] = [0..0, 0..18, 0..37].map(|hidden| bytes(&here, hidden));
    let [plain_there, all_there] = [0..0, 0..37].map(|hidden| bytes(&there, hidden));
    for isa in Isa::available() {
        let run = |a: &[u8], b: &[u8]| engine_on(isa, &here, &there, [a, b].map(TargetRgb::Bytes), &WEIGHTS);
        let (seen, _) = run(&plain, &plain_there);
        let (part, gradient) = run(&half, &plain_there);
        assert!(part.normal > 0.1 * seen.normal && part.normal < 0.9 * seen.normal, "{part:?}, {seen:?}");
        assert!(part.returned > 0.0 && part.returned < 0.8 * seen.returned, "{part:?}, {seen:?}");
        for (plane, y, x) in
            (NORMAL..=DISTANCE).flat_map(|p| (0..34).flat_map(move |y| (0..18).map(move |x| (p, y, x))))
        {
            assert_eq!(gradient.value(plane, x, y), 0.0, "plane {plane} at {x}, {y}");
        }
        let (neighbourless, _) = run(&plain, &all_there);
        assert_eq!((neighbourless.returned, neighbourless.matched), (0.0, 0.0));
        assert!((neighbourless.normal - seen.normal).abs() < 1e-9);
        assert_eq!(run(&all, &plain_there).0, SurfaceLoss::default());
    }
}
