//! Scores a model on photographs, and on the true surface if it is known. Only missions and users have
//! photographs. The receiving service never has any, so it cannot score models.

use cosurf_engine::backend::TargetRgb;
use cosurf_engine::{Rendering, ViewError, Views, aligned};
use cosurf_scene::{Camera, Cast, Picture, Shrinking, View, mask, metrics};
use tracing::debug_span;

use super::quality::{Quality, Yardsticks};
use super::surface::SurfaceQuality;

/// Scores a model by rendering it from the cameras of photographs.
pub(crate) struct Judge<'a> {
    model: Views,
    max_size_px: u32,
    yardsticks: &'a Yardsticks,
    /// See [`Self::aligning`].
    extent: Option<f64>,
}

/// A photograph and the model's rendering from the same camera.
pub(crate) struct Comparison {
    /// The camera, scaled to the size of both pictures.
    pub(crate) camera: Camera,
    /// The photograph.
    pub(crate) photograph: Picture,
    /// The rendering. Its colours are clamped to 0..=1, as they are in a picture file.
    pub(crate) rendering: Rendering,
    /// The true surface as the camera sees it; `None` if it is not known.
    pub(crate) truth: Option<Cast>,
}

impl<'a> Judge<'a> {
    /// Pictures are shrunk until their long side is at most `max_size_px`; `None` keeps their size.
    pub(crate) fn new(model: Views, max_size_px: Option<u32>, yardsticks: &'a Yardsticks) -> Self {
        let max_size_px = max_size_px.unwrap_or(u32::MAX);
        Self { model, max_size_px, yardsticks, extent: None }
    }

    /// With the extent of the scene, world units, each camera is first aligned with the model: for models whose poses were
    /// learnt.
    pub(crate) fn aligning(self, extent: Option<f64>) -> Self {
        Self { extent, ..self }
    }

    /// Tells which views will be asked for next.
    pub(crate) fn expect<'v>(&mut self, views: impl Iterator<Item = &'v View>) {
        self.model.expect(views.map(|view| view.camera.fitted(self.max_size_px)).collect());
    }

    /// The figures of some views, in their order.
    pub(crate) fn qualities(&mut self, views: &[&View]) -> Result<Vec<Quality>, ViewError> {
        self.expect(views.iter().copied());
        views.iter().map(|view| self.quality(view)).collect()
    }

    /// Computes all figures of a view.
    pub(crate) fn quality(&mut self, view: &View) -> Result<Quality, ViewError> {
        let _span = debug_span!("view", name = view.name).entered();
        let Comparison { camera, photograph, rendering, truth } = self.compare(view)?;
        let [psnr, ssim] = metrics::scores(&rendering.rgb, &photograph);
        let (size_px, wanted) = (photograph.size_px, shown_beside(&photograph, &rendering.rgb));
        let lpips = self.yardsticks.lpips.as_ref();
        Ok(Quality {
            psnr,
            ssim,
            lpips: lpips.and_then(|lpips| lpips.score(&rendering.rgb, &wanted, size_px)),
            surface: truth.and_then(|truth| SurfaceQuality::of(&rendering, &camera, &truth)),
        })
    }

    /// Reads the photograph of a view, and renders the model from the same camera.
    pub(crate) fn compare(&mut self, view: &View) -> Result<Comparison, ViewError> {
        let mut camera = view.camera.fitted(self.max_size_px);
        // The model first: how much of it fits depends on what the process holds already.
        let mut rendering = self.model.render(&camera)?;
        let mask = view.mask.as_ref();
        let photograph = mask::read(&view.path, mask, camera.size_px, Shrinking::AfterDecoding)?;
        if let Some(extent) = self.extent {
            let rgb = TargetRgb::Bytes(&photograph.rgb);
            (camera, rendering) =
                aligned(&camera, rendering, rgb, extent, |camera| self.model.render(camera))?;
        }
        rendering.rgb.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
        let truth = self.yardsticks.truth.as_ref().map(|caster| caster.cast_areas(&camera));
        Ok(Comparison { camera, photograph, rendering, truth })
    }
}

/// The colours of a photograph, 0 to 1, and those of the rendering where the photograph is masked.
fn shown_beside(photograph: &Picture, rendering: &[f32]) -> Vec<f32> {
    let mut wanted = photograph.to_unit();
    let pixels = wanted.as_chunks_mut::<3>().0.iter_mut().zip(rendering.as_chunks::<3>().0);
    pixels
        .zip(photograph.counted())
        .filter(|(_, counts)| !counts)
        .for_each(|((pixel, shown), _)| *pixel = *shown);
    wanted
}

#[cfg(test)]
mod tests {
    use super::*;
    use cosurf_engine::{DeviceChoice, Place};
    use cosurf_scene::{Caster, LocalFrame, Mesh, Pose, Splats, ply};
    use glam::{DVec2, DVec3};

    fn from_above() -> Camera {
        Camera {
            cam_from_world: Pose::look_at(DVec3::new(0.0, 0.0, 30.0), DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(30.0),
            center_px: DVec2::splat(16.0),
            size_px: [32, 32],
        }
    }

    /// Ground with three facets in each pixel; a pixel is 1 m wide on the ground. The facets rise and fall in
    /// turn, with a slope of 30 %.
    fn furrowed() -> Mesh {
        let corner = |k: u32, y: f32| [k as f32 / 3.0 - 16.0, y, if k.is_multiple_of(2) { 0.0 } else { 0.1 }];
        Mesh {
            positions: (0..=96).flat_map(|k| [corner(k, -16.0), corner(k, 16.0)]).collect(),
            triangles: (0..192).map(|i| [i, i + 1, i + 2]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn the_true_normal_of_a_pixel_is_the_mean_over_its_area() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("grey.png");
        let size_px = [32, 32];
        Picture { size_px, rgb: vec![128; 3 * 32 * 32] }.write_png(&path).expect("a picture");
        let mut level = Splats::with_capacity(1, 0);
        level.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [6.0, 6.0, -6.0], 8.0, &[0.0; 3]);
        let yardsticks = Yardsticks { lpips: None, truth: Some(Caster::new(&furrowed())) };
        let view = View { name: "grey".into(), camera: from_above(), path, mask: None };
        let file = folder.path().join("level.ply");
        ply::write(&file, &level, &LocalFrame::WORLD).expect("a file");
        let model = Views::open(file, &LocalFrame::WORLD, Place::On(DeviceChoice::Cpu), 1).expect("a model");
        let quality = Judge::new(model, None, &yardsticks).quality(&view).expect("a picture");
        let surface = quality.surface.expect("a surface");
        // Of the three facets in a pixel, two slope in opposite directions and cancel out, so the mean has a third
        // of the slope. The facet at the pixel's centre alone would give 16.7°.
        let third_deg = f64::atan(0.1).to_degrees();
        for errors in [surface.normal_error_deg, surface.depth_normal_error_deg] {
            assert!((errors.expect("pixels").median - third_deg).abs() < 0.1, "{errors:?}");
        }
    }
}
