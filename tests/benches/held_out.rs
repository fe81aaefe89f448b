//! The held-out views of a dataset.

use anyhow::Result;
use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::metrics::psnr;
use cosurf_scene::{Camera, Dataset, Picture, Splats};

/// Every eighth view is held out.
pub(crate) const EVERY: u32 = 8;
/// Threads to render with.
pub(crate) const THREADS: usize = 2;

/// Cameras and their photographs, `[0, 1]` row by row.
pub(crate) struct HeldOut(Vec<(Camera, Vec<f32>)>);

impl HeldOut {
    /// Reads the views. `resized` maps each view's camera to the camera to render with.
    pub(crate) fn read(dataset: &Dataset, resized: impl Fn(Camera) -> Camera) -> Result<Self> {
        let (_, held_out) = dataset.split(EVERY);
        let view = |i: &usize| {
            let view = &dataset.views[*i];
            let camera = resized(view.camera);
            Ok((camera, Picture::read_fitted(&view.path, camera.size_px)?.to_unit()))
        };
        Ok(Self(held_out.iter().map(view).collect::<Result<_>>()?))
    }

    /// Renders a model from every view.
    pub(crate) fn render(&self, splats: &Splats) -> Vec<Rendering> {
        let mut renderer = Renderer::new(splats, THREADS);
        self.0.iter().map(|(camera, _)| renderer.render(camera)).collect()
    }

    /// Mean PSNR of the renderings, dB.
    pub(crate) fn psnr(&self, renderings: &[Rendering]) -> f64 {
        let one = |(rendering, (_, photograph)): (&Rendering, &(Camera, Vec<f32>))| {
            let rgb: Vec<f32> = rendering.rgb.iter().map(|value| value.clamp(0.0, 1.0)).collect();
            psnr(&rgb, photograph)
        };
        renderings.iter().zip(&self.0).map(one).sum::<f64>() / renderings.len() as f64
    }
}
