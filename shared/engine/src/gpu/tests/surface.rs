//! Compares the surface losses of both backends, and the gradients with respect to the splats. A sample may differ
//! where rounding decides whether its reprojection error is below the limit or its patches match.

use cosurf_scene::picture::MASKED;
use cosurf_scene::{Camera, Splats};
use glam::DVec3;

use super::adapter::gpu;
use super::compare::{compare, on_cpu, on_gpu};
use super::forward::centered;
use crate::backend::{
    Backend, Channels, LossWeights, Losses, MultiviewWeights, PatchSide, Rendering, SurfaceWeights,
    TargetRgb, TargetSurface, Targets, TeacherWeights,
};
use crate::random::{Purpose, Random};
use crate::render::Renderer;

/// Share of the gradients that may differ by more than a thousandth. A sample that counts on only one of the backends
/// changes the gradients of all splats of its pixel.
const OFF_MAX: f64 = 0.01;
/// As [`OFF_MAX`], for losses that include the normal loss. A normal comes from the depths of four pixels. Where one
/// splat covers all four, their gradients cancel almost completely, and rounding errors remain.
const NORMALS_OFF_MAX: f64 = 0.02;
/// Largest difference of a loss, or of a share of samples, between the backends.
const LOSS_OFF_MAX: f64 = 1e-3;

/// Opaque discs of many colours on uneven ground.
fn ground(count: usize) -> Splats {
    let mut random = Random::new(17, Purpose::Test, 0, 0);
    let mut splats = Splats::with_capacity(count, 0);
    for _ in 0..count {
        let [x, y] = [0, 1].map(|_| 0.8 * random.normal());
        let quat = [1.0, 0.05 * random.normal(), 0.05 * random.normal(), random.normal()];
        let color = [0, 1, 2].map(|_| 0.6 * random.normal());
        splats.push([x, y, 0.1 * (3.0 * x).sin()], quat, [-2.2, -2.3, -4.5], 3.0, &color);
    }
    splats
}

/// Inputs of a step: a view, then its neighbour, and how far the teacher's surface is trusted at each pixel.
struct Shown {
    cameras: [Camera; 2],
    pictures: [Rendering; 2],
    trust: Vec<f32>,
}

impl Shown {
    fn new(truth: &Splats, size_px: [u32; 2]) -> Self {
        let eyes = [DVec3::new(1.5, 1.0, 3.0), DVec3::new(1.7, 0.8, 3.1)];
        let cameras = eyes.map(|eye| centered(eye, 1.2 * f64::from(size_px[0]), size_px));
        let mut renderer = Renderer::new(truth, 2);
        let pictures = cameras.map(|camera| renderer.render(&camera));
        let mut random = Random::new(5, Purpose::Test, 0, 0);
        let trust = pictures[0].alpha.iter().map(|_| random.below(5) as f32 / 4.0).collect();
        Self { cameras, pictures, trust }
    }

    /// Runs the passes of one step up to the gradients, and returns losses and gradients.
    fn step(&self, backend: &mut impl Backend, weights: &LossWeights) -> (Losses, Splats) {
        self.step_on(backend, weights, TargetRgb::Floats(&self.pictures[0].rgb), &bytes_of(&self.pictures[1]))
    }

    /// As [`Self::step`], with masks on both photographs.
    fn masked_step(&self, backend: &mut impl Backend, weights: &LossWeights) -> (Losses, Splats) {
        let [mut here, mut there] = self.pictures.each_ref().map(bytes_of);
        hide(&mut here, self.cameras[0].size_px, [30, 20]);
        hide(&mut there, self.cameras[1].size_px, [60, 50]);
        self.step_on(backend, weights, TargetRgb::Bytes(&here), &there)
    }

    fn step_on(
        &self,
        backend: &mut impl Backend,
        weights: &LossWeights,
        rgb: TargetRgb,
        neighbour: &[u8],
    ) -> (Losses, Splats) {
        let here = &self.pictures[0];
        backend.project(&self.cameras[1], 0);
        backend.bin();
        backend.rasterize(Channels::Geometry);
        backend.keep_neighbour();
        backend.project(&self.cameras[0], 0);
        backend.bin();
        assert_eq!(backend.counts().dropped, 0);
        backend.rasterize(Channels::Geometry);
        let surface = TargetSurface { depth: &here.depth, normal: &here.normal, trust: &self.trust };
        let targets = Targets {
            neighbour_rgb: Some(TargetRgb::Bytes(neighbour)),
            surface: Some(surface),
            ..Targets::colors(rgb)
        };
        let losses = backend.losses(&targets, weights);
        backend.rasterize_backward();
        backend.project_backward();
        (losses, backend.gradients())
    }
}

fn bytes_of(picture: &Rendering) -> Vec<u8> {
    picture.rgb.iter().map(|v| (255.0 * v.min(1.0)) as u8).collect()
}

/// Masks a square of 25 px.
fn hide(rgb: &mut [u8], size_px: [u32; 2], corner: [usize; 2]) {
    for y in corner[1]..corner[1] + 25 {
        let first = 3 * (y * size_px[0] as usize + corner[0]);
        rgb[first..first + 75].as_chunks_mut().0.fill(MASKED);
    }
}

/// Weights of the colour loss and of only one other loss: 0 for normals, 1 for reprojection, 2 for patches, 3 for the
/// teacher. `None` gives the weights of all.
fn weights(only: Option<usize>) -> LossWeights {
    let at = |k: usize, weight: f32| if only.is_none_or(|only| only == k) { weight } else { 0.0 };
    let multiview = MultiviewWeights {
        reprojection: at(1, 0.2),
        ncc: at(2, 0.7),
        cell_px: 2,
        patch: PatchSide::Px3,
        draw: 9,
    };
    let surface = SurfaceWeights { normal: at(0, 0.5), multiview: Some(multiview) };
    let teacher = TeacherWeights { depth: at(3, 0.3), normal: at(3, 0.1) };
    LossWeights {
        ssim: 0.2,
        scale: 0.0,
        surface: Some(surface),
        teacher: (only.is_none_or(|only| only == 3)).then_some(teacher),
    }
}

fn numbers(losses: &Losses) -> [f64; 8] {
    let Losses { color, surface, teacher } = losses;
    [
        color.total,
        surface.normal,
        surface.reprojection,
        surface.ncc,
        surface.returned,
        surface.matched,
        teacher.depth,
        teacher.normal,
    ]
}

#[test]
fn surface_losses_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let truth = ground(3000);
    let mut model = truth.clone();
    let mut random = Random::new(3, Purpose::Test, 0, 0);
    model.means.iter_mut().flatten().for_each(|v| *v += 0.01 * random.normal());
    for size_px in [[120, 90], [5, 4], [1, 1]] {
        let shown = Shown::new(&truth, size_px);
        let narrow = [Some(0), Some(1), Some(2), Some(3), None].map(|only| (only, PatchSide::Px3));
        for (only, patch) in narrow.into_iter().chain([(Some(2), PatchSide::Px7)]) {
            let mut weights = weights(only);
            weights.surface.iter_mut().flat_map(|its| &mut its.multiview).for_each(|its| its.patch = patch);
            let (got_losses, got) = shown.step(&mut on_gpu(&gpu, &model, size_px), &weights);
            let (losses, expected) = shown.step(&mut on_cpu(&model, size_px), &weights);
            let (count, off) = compare(&got, &expected);
            println!(
                "{size_px:?} {only:?} {patch:?}: {off} of {count} gradients are off; {:.4?}",
                numbers(&losses)
            );
            for (got, expected) in numbers(&got_losses).into_iter().zip(numbers(&losses)) {
                assert!((got - expected).abs() <= LOSS_OFF_MAX, "{only:?}: {got_losses:?} is not {losses:?}");
            }
            // In a picture of twenty pixels or fewer, a single tie would exceed the allowed share.
            if size_px[0] < 100 {
                continue;
            }
            let off_max = if weights.surface.is_some_and(|surface| surface.normal > 0.0) {
                NORMALS_OFF_MAX
            } else {
                OFF_MAX
            };
            assert!(off as f64 <= off_max * count as f64, "{size_px:?} {only:?}: {off} of {count} are off");
            assert!(losses.surface.returned > 0.5 && losses.surface.matched > 0.1, "{losses:?}");
            // The comparison must also notice weights that are a percent too large.
            let mut heavier = weights;
            let surface = heavier.surface.as_mut().expect("a surface");
            surface.normal *= 1.01;
            if let Some(multiview) = &mut surface.multiview {
                (multiview.reprojection, multiview.ncc) =
                    (1.01 * multiview.reprojection, 1.01 * multiview.ncc);
            }
            if let Some(teacher) = &mut heavier.teacher {
                (teacher.depth, teacher.normal) = (1.01 * teacher.depth, 1.01 * teacher.normal);
            }
            let (_, wrong) = shown.step(&mut on_gpu(&gpu, &model, size_px), &heavier);
            let (_, off) = compare(&wrong, &expected);
            assert!(off as f64 > off_max * count as f64, "{only:?}: a wrong weight went unnoticed ({off})");
        }
    }
}

#[test]
fn masked_pixels_are_left_out_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let truth = ground(3000);
    let mut model = truth.clone();
    let mut random = Random::new(3, Purpose::Test, 0, 0);
    model.means.iter_mut().flatten().for_each(|v| *v += 0.01 * random.normal());
    let shown = Shown::new(&truth, [120, 90]);
    for only in [Some(0), Some(1), Some(2)] {
        let weights = weights(only);
        let (got_losses, got) = shown.masked_step(&mut on_gpu(&gpu, &model, [120, 90]), &weights);
        let (losses, expected) = shown.masked_step(&mut on_cpu(&model, [120, 90]), &weights);
        let (count, off) = compare(&got, &expected);
        for (got, expected) in numbers(&got_losses).into_iter().zip(numbers(&losses)) {
            assert!((got - expected).abs() <= LOSS_OFF_MAX, "{only:?}: {got_losses:?} is not {losses:?}");
        }
        // Photographs of whole levels have more ties than renderings.
        assert!(off as f64 <= 2.0 * NORMALS_OFF_MAX * count as f64, "{only:?}: {off} of {count} are off");
        let (_, unmasked) = shown.step(&mut on_cpu(&model, [120, 90]), &weights);
        let (_, off) = compare(&unmasked, &expected);
        assert!(off as f64 > 0.05 * count as f64, "{only:?}: the masks went unnoticed ({off})");
    }
}
