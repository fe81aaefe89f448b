//! Shows a held-out view in pictures: the photograph, the renderings of the model, and their errors.

use cosurf_engine::ViewError;
use cosurf_scene::picture::MASKED;
use cosurf_scene::{Cast, Caster, Picture, View, colormap};
use image::ImageError;

use super::embed::Captioned;

use crate::evaluate::{Comparison, Judge, Quality, depth_errors_percent, normal_errors_deg};

/// Limit on the number of views that the report shows in pictures. They range from the best view to the worst.
const SHOWCASES: usize = 4;
/// Error of colour that is drawn in the brightest colour, percent of the largest colour value.
const COLOR_BRIGHT_PERCENT: f32 = 20.0;
/// Error of depth that is drawn in the brightest colour, percent of the true depth.
const DEPTH_BRIGHT_PERCENT: f32 = 2.0;
/// Error of normals that is drawn in the brightest colour, degrees.
const NORMAL_BRIGHT_DEG: f32 = 45.0;

/// Why a view cannot be shown.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ShowcaseError {
    /// The model cannot be rendered.
    #[error(transparent)]
    View(#[from] ViewError),
    /// A picture cannot be encoded.
    #[error(transparent)]
    Picture(#[from] ImageError),
}

/// A held-out view as a photograph and as renderings of the global model.
pub(crate) struct Showcase {
    /// Name of the view.
    pub(crate) name: String,
    /// The figures of the view.
    pub(crate) quality: Quality,
    /// Pictures of equal size, in this order: photograph, rendered colour, error of colour, depth, normals; then
    /// the mesh, if there is one; then the errors of depth and of normals, if the true surface is known.
    pub(crate) pictures: Vec<Captioned>,
}

impl Showcase {
    pub(crate) fn new(
        name: &str,
        quality: Quality,
        comparison: Comparison,
        mesh: Option<Cast>,
        unit: f64,
    ) -> Result<Self, ImageError> {
        let Comparison { photograph, rendering, truth, .. } = comparison;
        let size_px = rendering.size_px;
        let range = colormap::depth_range(truth.as_ref().map_or(&rendering.depth, |truth| &truth.depth));
        let [near_m, far_m] = range.map(|depth| depth * unit as f32);
        let mut pictures = vec![
            Captioned::new("photograph", &photograph)?,
            Captioned::new("colour", &Picture::from_unit(size_px, &rendering.rgb))?,
            Captioned::new(
                format!("colour error, 0 to {COLOR_BRIGHT_PERCENT} % (bright)"),
                &color_error(&photograph, &rendering.rgb),
            )?,
            Captioned::new(
                format!("depth, {near_m:.1} (bright) to {far_m:.1} m"),
                &colormap::depth_picture(&rendering.depth, size_px, range),
            )?,
            Captioned::new("normal", &colormap::normal_picture(&rendering.normal, size_px))?,
        ];
        if let Some(mesh) = &mesh {
            pictures.push(Captioned::new("mesh", &colormap::clay_picture(&mesh.normals, size_px))?);
        }
        if let Some(truth) = &truth {
            let depth = depth_errors_percent(&rendering, truth);
            let normal = normal_errors_deg(&rendering, truth);
            pictures.push(Captioned::new(
                format!("depth error, 0 to {DEPTH_BRIGHT_PERCENT} % (bright)"),
                &colormap::error_picture(&depth, size_px, DEPTH_BRIGHT_PERCENT),
            )?);
            pictures.push(Captioned::new(
                format!("normal error, 0 to {NORMAL_BRIGHT_DEG}° (bright)"),
                &colormap::error_picture(&normal, size_px, NORMAL_BRIGHT_DEG),
            )?);
        }
        Ok(Self { name: name.into(), quality, pictures })
    }
}

/// Returns the showcases of a few of `views`, the best view first. `qualities` are the figures of all `views`,
/// in their order; `unit` is the length of the judge's unit, metres.
pub(crate) fn showcases(
    judge: &mut Judge,
    views: &[&View],
    qualities: &[Quality],
    mesh: Option<&Caster>,
    unit: f64,
) -> Result<Vec<Showcase>, ShowcaseError> {
    let shown = spread(qualities);
    judge.expect(shown.iter().map(|i| views[*i]));
    let show = |i: usize| {
        let comparison = judge.compare(views[i])?;
        let mesh = mesh.map(|mesh| mesh.cast(&comparison.camera));
        Ok(Showcase::new(&views[i].name, qualities[i], comparison, mesh, unit)?)
    };
    shown.into_iter().map(show).collect()
}

/// Indices of up to [`SHOWCASES`] views, evenly spread over the ranks by PSNR: the best is first and the worst
/// is last.
fn spread(qualities: &[Quality]) -> Vec<usize> {
    let mut ranked: Vec<usize> = (0..qualities.len()).collect();
    ranked.sort_by(|&a, &b| qualities[b].psnr.total_cmp(&qualities[a].psnr));
    let count = SHOWCASES.min(ranked.len());
    let last = ranked.len().saturating_sub(1);
    (0..count).map(|i| ranked[i * last / (count - 1).max(1)]).collect()
}

/// Draws the error of colour: in each pixel, the mean over the channels of the absolute difference; 0 where the photograph is
/// masked.
fn color_error(photograph: &Picture, rgb: &[f32]) -> Picture {
    let pixels = photograph.rgb.as_chunks::<3>().0.iter().zip(rgb.as_chunks::<3>().0);
    let percent = |(wanted, got): (&[u8; 3], &[f32; 3])| {
        if *wanted == MASKED {
            return 0.0;
        }
        let differences = wanted.iter().zip(got).map(|(&w, &g)| (f32::from(w) / 255.0 - g).abs());
        100.0 / 3.0 * differences.sum::<f32>()
    };
    let errors: Vec<f32> = pixels.map(percent).collect();
    colormap::error_picture(&errors, photograph.size_px, COLOR_BRIGHT_PERCENT)
}

#[cfg(test)]
mod tests {
    use cosurf_engine::Rendering;
    use cosurf_scene::{Camera, Pose};
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    fn captions(truth: Option<Cast>, mesh: Option<Cast>) -> Vec<String> {
        let camera = Camera {
            cam_from_world: Pose { rotation: DQuat::IDENTITY, translation: DVec3::ZERO },
            focal_px: DVec2::ONE,
            center_px: DVec2::new(1.0, 0.5),
            size_px: [2, 1],
        };
        let rendering = Rendering {
            size_px: [2, 1],
            rgb: vec![0.5; 6],
            alpha: vec![1.0; 2],
            depth: vec![30.0, 61.0],
            normal: vec![0.0; 6],
        };
        let comparison =
            Comparison { camera, photograph: Picture::new([2, 1], vec![9; 6]), rendering, truth };
        let quality = Quality { psnr: 20.0, ssim: 0.5, lpips: None, surface: None };
        let showcase = Showcase::new("view", quality, comparison, mesh, 1.0);
        let Showcase { pictures, .. } = showcase.expect("small pictures");
        assert!(pictures.iter().all(|captioned| captioned.size_px == [2, 1]));
        pictures.into_iter().map(|captioned| captioned.caption).collect()
    }

    #[test]
    fn errors_of_depth_are_shown_if_the_truth_is_known() {
        let cast = Cast { size_px: [2, 1], depth: vec![30.0, 60.0], normals: vec![[0.0, 0.0, -1.0]; 2] };
        let with = captions(Some(cast.clone()), Some(cast));
        assert_eq!((with.len(), &with[3][..]), (8, "depth, 30.0 (bright) to 60.0 m"));
        assert_eq!(with[5], "mesh");
        assert!(with[6].starts_with("depth error") && with[7].starts_with("normal error"));
        let without = captions(None, None);
        assert_eq!((without.len(), &without[3][..]), (5, "depth, 30.0 (bright) to 61.0 m"));
    }

    #[test]
    fn the_largest_color_error_is_the_brightest() {
        let photograph = Picture::new([3, 1], vec![0, 0, 0, 0, 0, 0, 255, 255, 255]);
        let colors = [0.0, 0.0, 0.0, 0.05, 0.0, 0.1, 0.0, 0.0, 0.0];
        let picture = color_error(&photograph, &colors);
        let luma = |i: usize| picture.rgb[3 * i..3 * i + 3].iter().map(|&byte| u32::from(byte)).sum::<u32>();
        assert!(luma(0) < luma(1) && luma(1) < luma(2), "{:?}", picture.rgb);
        let masked = color_error(&Picture::new([3, 1], MASKED.repeat(3)), &colors);
        assert_eq!(masked.rgb[..3], masked.rgb[6..], "where it is masked, there is no error");
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
