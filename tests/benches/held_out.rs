//! The held-out views of a dataset.

use anyhow::Result;
use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::metrics::psnr;
use cosurf_scene::{Camera, Dataset, Picture, Splats};

/// Every eighth view is held out.
pub(crate) const EVERY: u32 = 8;
/// Threads to render with.
pub(crate) const THREADS: usize = 2;

/// The held-out views: each camera with its photograph, RGB values in 0..=1, row by row.
pub(crate) struct HeldOut(pub(crate) Vec<(Camera, Vec<f32>)>);

impl HeldOut {
    /// Reads the held-out views. `resized` maps each view's camera to the camera to render with. Each photograph is
    /// scaled to the size of the mapped camera.
    pub(crate) fn read(dataset: &Dataset, resized: impl Fn(Camera) -> Camera) -> Result<Self> {
        let (_, held_out) = dataset.split(EVERY);
        let view = |i: &usize| {
            let view = &dataset.views[*i];
            let camera = resized(view.camera);
            Ok((camera, Picture::read_fitted(&view.path, camera.size_px)?.to_unit()))
        };
        Ok(Self(held_out.iter().map(view).collect::<Result<_>>()?))
    }

    /// Renders a model at every held-out camera.
    pub(crate) fn render(&self, splats: &Splats) -> Vec<Rendering> {
        let mut renderer = Renderer::new(splats, THREADS);
        self.0.iter().map(|(camera, _)| renderer.render(camera)).collect()
    }

    /// Mean PSNR between the renderings and the photographs, dB. NaN if no view is held out.
    pub(crate) fn psnr(&self, renderings: &[Rendering]) -> f64 {
        let one = |(rendering, (_, photograph)): (&Rendering, &(Camera, Vec<f32>))| {
            let rgb: Vec<f32> = rendering.rgb.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            psnr(&rgb, photograph)
        };
        renderings.iter().zip(&self.0).map(one).sum::<f64>() / renderings.len() as f64
    }
}
