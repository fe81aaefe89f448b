//! A model on held-out photographs, and on the true surface where there is one. Only who has the photographs
//! at hand can do this, as a mission or a person does; the receiving service never does.

use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::{Camera, Cast, Caster, Picture, SceneError, Splats, View, metrics};

use crate::quality::{Quality, Yardsticks};
use crate::showcase::Showcase;
use crate::surface::SurfaceQuality;

/// Views shown in the report, spread from the worst to the best.
const SHOWCASES: usize = 4;

/// What the global model is worth.
pub(crate) struct Evaluation {
    /// One per view, in their order.
    pub(crate) qualities: Vec<Quality>,
    /// A few of them, the best first.
    pub(crate) showcases: Vec<Showcase>,
}

/// Judges every view, and shows a few, with what they see of the `mesh`.
pub(crate) fn evaluate(
    judge: &mut Judge,
    views: &[&View],
    mesh: Option<&Caster>,
) -> Result<Evaluation, SceneError> {
    let qualities = views.iter().map(|view| judge.quality(view)).collect::<Result<Vec<_>, _>>()?;
    let show = |i: usize| {
        let look = judge.look(views[i])?;
        let mesh = mesh.map(|mesh| mesh.cast(&look.camera));
        Ok(Showcase::new(&views[i].name, qualities[i], look, mesh))
    };
    let showcases = spread(&qualities).into_iter().map(show).collect::<Result<Vec<_>, SceneError>>()?;
    Ok(Evaluation { qualities, showcases })
}

/// Renders a model where photographs were taken.
pub(crate) struct Judge<'a> {
    renderer: Renderer,
    max_size_px: u32,
    yardsticks: &'a Yardsticks,
}

/// A photograph beside its rendering.
pub(crate) struct Look {
    /// Whose pixels these are.
    pub(crate) camera: Camera,
    /// The photograph.
    pub(crate) photograph: Picture,
    /// What the model shows there, colours clamped to 0..=1, as in a picture file.
    pub(crate) rendering: Rendering,
    /// The true surface as the camera sees it.
    pub(crate) truth: Option<Cast>,
}

impl<'a> Judge<'a> {
    /// Takes a copy of the splats. Pictures are shrunk until they are at most `max_size_px` long.
    pub(crate) fn new(
        splats: &Splats,
        max_size_px: Option<u32>,
        threads: usize,
        yardsticks: &'a Yardsticks,
    ) -> Self {
        let max_size_px = max_size_px.unwrap_or(u32::MAX);
        Self { renderer: Renderer::new(splats, threads), max_size_px, yardsticks }
    }

    /// Every figure of a view.
    pub(crate) fn quality(&mut self, view: &View) -> Result<Quality, SceneError> {
        let Look { camera, photograph, rendering, truth } = self.look(view)?;
        let (size_px, wanted) = (photograph.size_px, photograph.to_unit());
        let lpips = self.yardsticks.lpips.as_ref();
        Ok(Quality {
            psnr: metrics::psnr(&rendering.rgb, &wanted),
            ssim: metrics::ssim(&rendering.rgb, &wanted, size_px),
            lpips: lpips.and_then(|lpips| lpips.score(&rendering.rgb, &wanted, size_px)),
            surface: truth.and_then(|truth| SurfaceQuality::of(&rendering, &camera, &truth)),
        })
    }

    fn look(&mut self, view: &View) -> Result<Look, SceneError> {
        let camera = view.camera.resized(view.camera.fitted_size(self.max_size_px));
        let photograph = Picture::read_fitted(&view.path, camera.size_px)?;
        let mut rendering = self.renderer.render(&camera);
        rendering.rgb.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
        let truth = self.yardsticks.truth.as_ref().map(|caster| caster.cast_areas(&camera));
        Ok(Look { camera, photograph, rendering, truth })
    }
}

/// Indices of up to [`SHOWCASES`] views, evenly spread over the ranks by PSNR, the best first and the
/// worst last.
fn spread(qualities: &[Quality]) -> Vec<usize> {
    let mut ranked: Vec<usize> = (0..qualities.len()).collect();
    ranked.sort_by(|&a, &b| qualities[b].psnr.total_cmp(&qualities[a].psnr));
    let count = SHOWCASES.min(ranked.len());
    let last = ranked.len().saturating_sub(1);
    (0..count).map(|i| ranked[i * last / (count - 1).max(1)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cosurf_scene::{Mesh, Pose};
    use glam::{DVec2, DVec3};

    fn from_above() -> Camera {
        Camera {
            cam_from_world: Pose::look_at(DVec3::new(0.0, 0.0, 30.0), DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(30.0),
            center_px: DVec2::splat(16.0),
            size_px: [32, 32],
        }
    }

    /// Three furrows to a pixel, which is 1 m wide on the ground; facets up and down by 30 % in turns.
    fn furrowed() -> Mesh {
        let corner = |k: u32, y: f32| [k as f32 / 3.0 - 16.0, y, if k.is_multiple_of(2) { 0.0 } else { 0.1 }];
        Mesh {
            positions: (0..=96).flat_map(|k| [corner(k, -16.0), corner(k, 16.0)]).collect(),
            triangles: (0..192).map(|i| [i, i + 1, i + 2]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn a_pixel_is_judged_by_all_that_lies_in_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("grey.png");
        let size_px = [32, 32];
        Picture { size_px, rgb: vec![128; 3 * 32 * 32] }.write_png(&path).expect("a picture");
        let mut level = Splats::with_capacity(1, 0);
        level.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [6.0, 6.0, -6.0], 8.0, &[0.0; 3]);
        let yardsticks = Yardsticks { lpips: None, truth: Some(Caster::new(&furrowed())) };
        let view = View { name: "grey".into(), camera: from_above(), path };
        let quality = Judge::new(&level, None, 1, &yardsticks).quality(&view).expect("a picture");
        let surface = quality.surface.expect("a surface");
        // By the facets at the centres of the pixels: 16.7°.
        let third_deg = f64::atan(0.1).to_degrees();
        for errors in [surface.normal_error_deg, surface.depth_normal_error_deg] {
            assert!((errors.expect("pixels").median - third_deg).abs() < 0.1, "{errors:?}");
        }
    }

    #[test]
    fn showcases_go_from_the_best_to_the_worst() {
        let quality = |&psnr: &f64| Quality { psnr, ssim: 0.0, lpips: None, surface: None };
        let qualities = |psnrs: &[f64]| -> Vec<Quality> { psnrs.iter().map(quality).collect() };
        assert_eq!(spread(&qualities(&[3.0, 9.0, 1.0, 7.0, 5.0, 8.0, 2.0])), [1, 3, 0, 2]);
        assert_eq!(spread(&qualities(&[3.0, 9.0])), [1, 0]);
        assert_eq!(spread(&qualities(&[3.0])), [0]);
        assert!(spread(&[]).is_empty());
    }
}
