//! Scores of a model on held-out pictures.

use anyhow::Result;
use cosurf_engine::backend::TargetRgb;
use cosurf_engine::{Rendering, aligned};
use cosurf_scene::{Camera, Shrinking, View, mask, metrics};
use serde::Serialize;
use tracing::info_span;

/// The picture in bytes, then in 32-bit floats, and which of its pixels count.
const TRUTH_BYTES_PER_PIXEL: u64 = 3 + 12 + 1;
/// SSIM keeps five maps of three channels in 64-bit floats, of 13 rows.
const SSIM_BYTES_PER_COLUMN: u64 = 13 * 5 * 3 * 8;

/// A picture that one plain colour shows better than this has too little in it to tell whether anything was learnt, dB.
const PLAIN_PSNR_MAX: f64 = 30.0;

/// The scores of one view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    /// The view's name.
    pub name: String,
    /// PSNR, dB.
    pub psnr: f64,
    /// SSIM, -1..=1.
    pub ssim: f64,
    /// PSNR of one plain colour, the picture's mean, dB. A model that shows the view no better has learnt nothing of it.
    pub plain_psnr: f64,
}

/// The scores of a model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Mean PSNR over the views, dB; `None` without views.
    pub psnr: Option<f64>,
    /// Mean SSIM over the views, -1..=1; `None` without views.
    pub ssim: Option<f64>,
    /// The scores of each view, in the order in which the views were given.
    pub views: Vec<ViewScore>,
}

impl Score {
    /// Whether the model shows none of the views better than one plain colour does. Never with fewer than two views: one
    /// alone may lie beside what the others show.
    pub fn shows_nothing(&self) -> bool {
        let is_blank = |view: &ViewScore| view.psnr <= view.plain_psnr.min(PLAIN_PSNR_MAX);
        self.views.len() >= 2 && self.views.iter().all(is_blank)
    }
}

/// Upper bound on the bytes that [`score`] allocates besides the rendering. Fails if the header of a picture cannot be
/// read.
pub fn scratch_bytes(views: &[View], max_size_px: u32, shrinking: Shrinking) -> Result<u64> {
    let of = |view: &View| -> Result<u64> {
        let size_px = view.camera.fitted_size(max_size_px);
        let pixels = u64::from(size_px[0]) * u64::from(size_px[1]);
        let row = u64::from(size_px[0]) * SSIM_BYTES_PER_COLUMN;
        let mask = view.mask.as_ref();
        let reading = mask::scratch_bytes(&view.path, mask, size_px, shrinking)?;
        Ok(reading + pixels * TRUTH_BYTES_PER_PIXEL + row)
    };
    views.iter().try_fold(0, |most, view| Ok(of(view)?.max(most)))
}

/// Renders each view with a long side of at most `max_size_px`, and compares the rendering with the pixels of the view's
/// picture that count. With an `extent`, which is that of the scene in world units, each camera is first aligned with the model:
/// for models whose poses were learnt. Rendered colours are first clamped to 0..=1, as they are in a picture file. Fails if a
/// picture cannot be read or rendered.
pub fn score(
    mut render: impl FnMut(&Camera) -> Result<Rendering>,
    views: &[View],
    max_size_px: u32,
    shrinking: Shrinking,
    extent: Option<f64>,
) -> Result<Score> {
    let _span = info_span!("evaluate", views = views.len()).entered();
    let scores = views
        .iter()
        .map(|view| {
            let size_px = view.camera.fitted_size(max_size_px);
            // The model first: how much of it fits depends on what the process holds already.
            let camera = view.camera.resized(size_px);
            let mut rendering = render(&camera)?;
            let photograph = mask::read(&view.path, view.mask.as_ref(), size_px, shrinking)?;
            if let Some(extent) = extent {
                let rgb = TargetRgb::Bytes(&photograph.rgb);
                (_, rendering) = aligned(&camera, rendering, rgb, extent, &mut render)?;
            }
            rendering.rgb.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
            let [psnr, ssim] = metrics::scores(&rendering.rgb, &photograph);
            Ok(ViewScore {
                name: view.name.clone(),
                psnr,
                ssim,
                plain_psnr: metrics::plain_psnr(&photograph),
            })
        })
        .collect::<Result<Vec<_>>>()?;
    let mean = |of: fn(&ViewScore) -> f64| {
        (!scores.is_empty()).then(|| scores.iter().map(of).sum::<f64>() / scores.len() as f64)
    };
    Ok(Score { psnr: mean(|s| s.psnr), ssim: mean(|s| s.ssim), views: scores })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_model_shows_nothing_if_no_view_is_better_than_a_plain_colour() {
        let shows_nothing = |views: &[[f64; 2]]| {
            let view = |[psnr, plain_psnr]: &[f64; 2]| ViewScore {
                name: String::new(),
                psnr: *psnr,
                ssim: 0.0,
                plain_psnr: *plain_psnr,
            };
            Score { psnr: None, ssim: None, views: views.iter().map(view).collect() }.shows_nothing()
        };
        assert!(shows_nothing(&[[10.0, 11.0], [10.5, 10.8]]));
        assert!(!shows_nothing(&[[10.0, 11.0], [20.0, 10.8]]), "one view is learnt");
        assert!(!shows_nothing(&[[10.0, 11.0]]), "one view alone says little");
        assert!(!shows_nothing(&[[50.0, f64::INFINITY], [50.0, f64::INFINITY]]), "plain pictures");
    }
}
