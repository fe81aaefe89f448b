//! What a model costs on the wire and what it loses there, layer by layer.
//!
//! `cargo bench -p cosurf-tests --bench layers -- --help`
//!
//! PSNR is that of the held-out views; the changes of normals and depth are medians over their pixels, of the
//! model that went through the wire beside the one that did not. Where the dataset has the true surface, the last
//! column is how much larger the median error of the normals has become.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::evaluate::{EvalOrder, evaluate_model};
use cosurf_engine::{Renderer, Rendering, base_of};
use cosurf_link::{FirstLayer, Model, model_to_body, part_to_model};
use cosurf_scene::metrics::psnr;
use cosurf_scene::splats::sh_coefficients;
use cosurf_scene::{Camera, Dataset, Picture, Splats, ply};
use glam::Vec3;

/// Parts of a body whose worth is told.
const PARTS: [f64; 6] = [0.1, 0.2, 0.4, 0.6, 0.8, 1.0];
/// Threads to render with.
const THREADS: usize = 2;

/// What the beginnings of a packed model are worth, a table on standard output.
#[derive(Parser)]
struct Arguments {
    /// A trained model
    model: PathBuf,
    /// The dataset that it was trained on
    data: PathBuf,
    /// Cut spherical harmonics to this degree
    #[arg(long, value_name = "N", default_value_t = 3)]
    sh_degree: u32,
    /// Shrink pictures until their long side is at most this many pixels [default: full size]
    #[arg(long, value_name = "PX", default_value_t = u32::MAX, hide_default_value = true)]
    max_size: u32,
    /// What cargo says to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let Arguments { model, data, sh_degree, max_size, .. } = Arguments::parse();
    let splats = of_degree(&ply::read(&model)?, sh_degree);
    let views = Views::read(&Dataset::open(&data)?, max_size)?;
    let base =
        base_of(&splats, &views.taught, THREADS, usize::MAX, |_, _| ()).context("a model too small")?;
    let body = model_to_body(&splats, &views.taught, FirstLayer::Base(&base))?;
    let whole = views.render(&splats);
    println!("{} splats of degree {}, {} cameras", splats.len(), splats.sh_degree, views.taught.len());
    println!("{} bytes, {:.2} a splat", body.len(), body.len() as f64 / splats.len() as f64);
    println!("as 32-bit floats: PSNR {:.3} dB", views.psnr(&whole));
    let errors = NormalErrors::of(&data, max_size)?;
    let error = errors.median_deg(&splats)?;
    if let Some(error) = error {
        println!("as 32-bit floats: median error of the normals {error:.3}°");
    }
    println!("| bytes | of all | splats | PSNR, dB | lost | normal, ° | depth, % | error of normals, ° |");
    println!("|---|---|---|---|---|---|---|---|");
    for part in PARTS {
        let end = (part * body.len() as f64) as usize;
        let Some(Model { splats, .. }) = part_to_model(&body, |range| range.end <= end)? else { continue };
        let pictures = views.render(&splats);
        let (psnr, lost) = (views.psnr(&pictures), views.psnr(&whole) - views.psnr(&pictures));
        let (normal, depth) = changes(&pictures, &whole);
        let lost_deg = error.zip(errors.median_deg(&splats)?).map(|(before, after)| after - before);
        println!(
            "| {end} | {:.0} % | {} | {psnr:.3} | {lost:.3} | {normal:.3} | {depth:.4} | {} |",
            100.0 * part,
            splats.len(),
            lost_deg.map_or("–".into(), |lost_deg| format!("{lost_deg:+.3}"))
        );
    }
    Ok(())
}

/// What the held-out views' normals are held against.
struct NormalErrors {
    order: EvalOrder,
    folder: tempfile::TempDir,
}

impl NormalErrors {
    fn of(data: &Path, max_size: u32) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let (model, data) = (folder.path().join("model.ply"), data.to_path_buf());
        let max_size_px = (max_size < u32::MAX).then_some(max_size);
        let order =
            EvalOrder { model, data, lpips: None, truth: None, eval_every: 8, max_size_px, threads: THREADS };
        Ok(Self { order, folder })
    }

    /// `None` where there is no true surface.
    fn median_deg(&self, splats: &Splats) -> Result<Option<f64>> {
        ply::write(&self.folder.path().join("model.ply"), splats)?;
        let surface = evaluate_model(&self.order)?.mean.surface;
        Ok(surface.and_then(|surface| surface.normal_error_deg).map(|error| error.median))
    }
}

/// The model with its spherical harmonics cut to a degree.
fn of_degree(splats: &Splats, sh_degree: u32) -> Splats {
    let degree = sh_degree.min(splats.sh_degree);
    let mut cut = Splats::with_capacity(splats.len(), degree);
    for i in 0..splats.len() {
        let sh = &splats.sh_of(i)[..3 * sh_coefficients(degree)];
        cut.push(splats.means[i], splats.quats[i], splats.log_scales[i], splats.opacity_logits[i], sh);
    }
    cut
}

struct Views {
    taught: Vec<Camera>,
    held_out: Vec<(Camera, Vec<f32>)>,
}

impl Views {
    fn read(dataset: &Dataset, long_side_px: u32) -> Result<Self> {
        let (taught, held_out) = dataset.split(8);
        let camera = |i: &usize| {
            let camera = dataset.views[*i].camera;
            camera.resized(camera.fitted_size(long_side_px))
        };
        let with_picture = |i: &usize| {
            let camera = camera(i);
            Ok((camera, Picture::read_fitted(&dataset.views[*i].path, camera.size_px)?.to_unit()))
        };
        Ok(Self {
            taught: taught.iter().map(camera).collect(),
            held_out: held_out.iter().map(with_picture).collect::<Result<_>>()?,
        })
    }

    fn render(&self, splats: &Splats) -> Vec<Rendering> {
        let mut renderer = Renderer::new(splats, THREADS);
        self.held_out.iter().map(|(camera, _)| renderer.render(camera)).collect()
    }

    fn psnr(&self, pictures: &[Rendering]) -> f64 {
        let one = |(picture, (_, truth)): (&Rendering, &(Camera, Vec<f32>))| {
            let rgb: Vec<f32> = picture.rgb.iter().map(|v| v.clamp(0.0, 1.0)).collect();
            psnr(&rgb, truth)
        };
        pictures.iter().zip(&self.held_out).map(one).sum::<f64>() / pictures.len() as f64
    }
}

/// Medians of the angle between normals, degrees, and of the change of depth, percent.
fn changes(found: &[Rendering], whole: &[Rendering]) -> (f32, f32) {
    let (mut angles, mut depths) = (Vec::new(), Vec::new());
    for (a, b) in found.iter().zip(whole) {
        for i in (0..a.depth.len()).filter(|&i| a.depth[i] > 0.0 && b.depth[i] > 0.0) {
            let [u, v] = [a, b].map(|picture| Vec3::from_slice(&picture.normal[3 * i..]));
            angles.push(u.cross(v).length().atan2(u.dot(v)).to_degrees());
            depths.push(100.0 * (a.depth[i] - b.depth[i]).abs() / b.depth[i]);
        }
    }
    (median(&mut angles), median(&mut depths))
}

fn median(values: &mut [f32]) -> f32 {
    values.sort_unstable_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f32::NAN)
}
