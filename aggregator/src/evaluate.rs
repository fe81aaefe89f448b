//! The global model on held-out photographs. Only a mission can do this, having the photographs at
//! hand; the receiving service never does.

use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::{Picture, SceneError, Splats, View, colormap, metrics};

use crate::page::Showcase;
use crate::report::Quality;

/// Views shown in the report, spread from the worst to the best.
const SHOWCASES: usize = 4;

/// What the global model is worth.
pub(crate) struct Evaluation {
    /// One per view, in their order.
    pub(crate) qualities: Vec<Quality>,
    /// A few of them, the best first.
    pub(crate) showcases: Vec<Showcase>,
}

/// Renders every view and compares it with its photograph, both at most `max_size_px` long.
pub(crate) fn evaluate(
    splats: &Splats,
    views: &[&View],
    max_size_px: Option<u32>,
    threads: usize,
) -> Result<Evaluation, SceneError> {
    let mut judge = Judge { renderer: Renderer::new(splats, threads), max_size_px };
    let look = |view: &&View| judge.look(view).map(|look| look.quality);
    let qualities = views.iter().map(look).collect::<Result<Vec<_>, _>>()?;
    let show = |i: usize| judge.look(views[i]).map(|look| look.showcase(views[i]));
    let showcases = spread(&qualities).into_iter().map(show).collect::<Result<Vec<_>, _>>()?;
    Ok(Evaluation { qualities, showcases })
}

struct Judge {
    renderer: Renderer,
    max_size_px: Option<u32>,
}

/// A photograph beside its rendering.
struct Look {
    truth: Picture,
    rendering: Rendering,
    quality: Quality,
}

impl Judge {
    fn look(&mut self, view: &View) -> Result<Look, SceneError> {
        let size_px = view.camera.fitted_size(self.max_size_px.unwrap_or(u32::MAX));
        let truth = Picture::read_fitted(&view.path, size_px)?;
        let mut rendering = self.renderer.render(&view.camera.resized(size_px));
        rendering.rgb.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
        let wanted = truth.to_unit();
        let quality = Quality {
            psnr: metrics::psnr(&rendering.rgb, &wanted),
            ssim: metrics::ssim(&rendering.rgb, &wanted, size_px),
        };
        Ok(Look { truth, rendering, quality })
    }
}

impl Look {
    fn showcase(self, view: &View) -> Showcase {
        let Rendering { size_px, rgb, depth, normal, .. } = self.rendering;
        let depth_range_m = colormap::depth_range(&depth);
        Showcase {
            name: view.name.clone(),
            quality: self.quality,
            depth_range_m,
            pictures: [
                self.truth,
                Picture::from_unit(size_px, &rgb),
                colormap::depth_picture(&depth, size_px, depth_range_m),
                colormap::normal_picture(&normal, size_px),
            ],
        }
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

    #[test]
    fn showcases_go_from_the_best_to_the_worst() {
        let qualities = |psnrs: &[f64]| -> Vec<Quality> {
            psnrs.iter().map(|&psnr| Quality { psnr, ssim: 0.0 }).collect()
        };
        assert_eq!(spread(&qualities(&[3.0, 9.0, 1.0, 7.0, 5.0, 8.0, 2.0])), [1, 3, 0, 2]);
        assert_eq!(spread(&qualities(&[3.0, 9.0])), [1, 0]);
        assert_eq!(spread(&qualities(&[3.0])), [0]);
        assert!(spread(&[]).is_empty());
    }
}
