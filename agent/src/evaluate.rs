//! Scores of a model on held-out pictures.

use anyhow::Result;
use cosurf_engine::Rendering;
use cosurf_scene::{Camera, Shrinking, View, mask, metrics};
use serde::Serialize;
use tracing::info_span;

/// The picture in bytes, then in 32-bit floats, and which of its pixels count.
const TRUTH_BYTES_PER_PIXEL: u64 = 3 + 12 + 1;
/// SSIM keeps five maps of three channels in 64-bit floats, of 13 rows.
const SSIM_BYTES_PER_COLUMN: u64 = 13 * 5 * 3 * 8;

/// The scores of one view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    /// The view's name.
    pub name: String,
    /// PSNR, dB.
    pub psnr: f64,
    /// SSIM, -1..=1.
    pub ssim: f64,
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
/// picture that count.
/// Rendered colours are first clamped to 0..=1, as they are in a picture file. Fails if a picture cannot be read or
/// rendered.
pub fn score(
    mut render: impl FnMut(&Camera) -> Result<Rendering>,
    views: &[View],
    max_size_px: u32,
    shrinking: Shrinking,
) -> Result<Score> {
    let _span = info_span!("evaluate", views = views.len()).entered();
    let scores = views
        .iter()
        .map(|view| {
            let size_px = view.camera.fitted_size(max_size_px);
            // The model first: how much of it fits depends on what the process holds already.
            let mut rendering = render(&view.camera.resized(size_px))?;
            let photograph = mask::read(&view.path, view.mask.as_ref(), size_px, shrinking)?;
            rendering.rgb.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
            let [psnr, ssim] = metrics::scores(&rendering.rgb, &photograph);
            Ok(ViewScore { name: view.name.clone(), psnr, ssim })
        })
        .collect::<Result<Vec<_>>>()?;
    let mean = |of: fn(&ViewScore) -> f64| {
        (!scores.is_empty()).then(|| scores.iter().map(of).sum::<f64>() / scores.len() as f64)
    };
    Ok(Score { psnr: mean(|s| s.psnr), ssim: mean(|s| s.ssim), views: scores })
}
