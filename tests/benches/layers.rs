//! Measures the size of a packed model, and the quality that it loses if only the first part of its bytes has
//! arrived.
//!
//! `cargo bench -p cosurf-tests --bench layers -- --help`
//!
//! PSNR is measured on held-out views. The columns `normal` and `depth` compare renderings of the unpacked part
//! with renderings of the original model: medians of the differences over pixels. If the dataset has a true
//! surface, the last column is the increase of the median error of the normals. Only the second of the two
//! printed tables goes to the results.

mod held_out;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::evaluate::{EvalOrder, evaluate_model};
use cosurf_engine::{Rendering, base_of};
use cosurf_link::{FirstLayer, Model, model_to_body, part_to_model};
use cosurf_scene::splats::sh_coefficients;
use cosurf_scene::{Camera, Dataset, LocalFrame, Splats, ply};
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use glam::Vec3;
use held_out::{EVERY, HeldOut, THREADS};

/// The measured cases: the share of a body's bytes that has arrived.
const PARTS: [f64; 6] = [0.1, 0.2, 0.4, 0.6, 0.8, 1.0];

/// Measure the quality of a packed model of which only the first bytes have arrived. Prints tables, and writes
/// JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// A trained model (PLY)
    model: PathBuf,
    /// Folder of the dataset that the model was trained on
    data: PathBuf,
    /// Name of the row in the results
    #[arg(long, default_value = "model")]
    name: String,
    /// Remove the spherical harmonics above this degree
    #[arg(long, value_name = "N", default_value_t = 3)]
    sh_degree: u32,
    /// Shrink pictures until their long side is at most this many pixels [default: full size]
    #[arg(long, value_name = "PX", default_value_t = u32::MAX, hide_default_value = true)]
    max_size: u32,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let Arguments { model, data, name, sh_degree, max_size, .. } = Arguments::parse();
    let splats = of_degree(&ply::read(&model, &LocalFrame::WORLD)?, sh_degree);
    let fitted = |camera: Camera| camera.fitted(max_size);
    let dataset = Dataset::open(&data)?;
    let cameras: Vec<Camera> =
        dataset.split(EVERY).0.iter().map(|i| fitted(dataset.views[*i].camera)).collect();
    let views = HeldOut::read(&dataset, fitted)?;
    let begun = Instant::now();
    let base = base_of(&splats, &cameras, 1, usize::MAX, |_, _| ()).context("a model too small")?;
    let base_s = begun.elapsed().as_secs_f64();
    let body = model_to_body(&splats, &cameras, &LocalFrame::WORLD, FirstLayer::Base(&base))?;
    let whole = views.render(&splats);
    println!("{} splats of degree {}, {} cameras", splats.len(), splats.sh_degree, cameras.len());
    println!("{} bytes, {:.2} a splat", body.len(), body.len() as f64 / splats.len() as f64);
    println!("as 32-bit floats: PSNR {:.3} dB", views.psnr(&whole));
    let errors = NormalErrors::of(&data, max_size)?;
    let error = errors.median_deg(&splats)?;
    if let Some(error) = error {
        println!("as 32-bit floats: median error of the normals {error:.3}°");
    }
    println!("| bytes | of all | splats | PSNR, dB | lost | normal, ° | depth, % | error of normals, ° |");
    println!("|---|---|---|---|---|---|---|---|");
    let mut losses = [None; PARTS.len()];
    for (loss, part) in losses.iter_mut().zip(PARTS) {
        let end = (part * body.len() as f64) as usize;
        let Some(Model { splats, .. }) = part_to_model(&body, |range| range.end <= end, &LocalFrame::WORLD)?
        else {
            continue;
        };
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
        *loss = Some(lost);
    }
    println!();
    let bytes = body.len() as f64 / splats.len() as f64;
    let figures = [
        Some(splats.len() as f64),
        Some(cameras.len() as f64),
        Some(base_s),
        Some(views.psnr(&whole)),
        Some(bytes),
    ];
    let mut measurement = Measurement::start("layers", &columns());
    // The columns begin with the whole body. The smallest part is left out, because it shows too little.
    let losses = losses.iter().rev().take(PARTS.len() - 1).copied();
    measurement.row(&name, &figures.into_iter().chain(losses).collect::<Vec<_>>());
    measurement.finish()?;
    Ok(())
}

fn columns() -> Vec<Column> {
    let bytes = Column::new("bytes a splat", "", 2).guarded(Better::Lower, Tolerance::Relative(0.02));
    let lost = |name| Column::new(name, "dB lost", 2).guarded(Better::Lower, Tolerance::Absolute(0.2));
    let parts = ["all", "first 80 %", "60 %", "40 %", "20 %"].map(lost);
    let base = Column::speed("base on one core", "s", 1, Better::Lower);
    let whole = [Column::splats(), Column::new("views", "", 0), base, Column::psnr("PSNR"), bytes];
    whole.into_iter().chain(parts).collect()
}

/// Measures the error of a model's normals against the true surface of a dataset.
struct NormalErrors {
    order: EvalOrder,
    folder: tempfile::TempDir,
}

impl NormalErrors {
    fn of(data: &Path, max_size: u32) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let (model, data) = (folder.path().join("model.ply"), data.to_path_buf());
        let max_size_px = (max_size < u32::MAX).then_some(max_size);
        let order = EvalOrder {
            model,
            data,
            lpips: None,
            truth: None,
            eval_every: EVERY,
            max_size_px,
            align: false,
            threads: THREADS,
        };
        Ok(Self { order, folder })
    }

    /// Median error of the blended normals, degrees, as the mean over held-out views. `None` if the dataset has no
    /// true surface, or no pixel has both a blended and a true normal.
    fn median_deg(&self, splats: &Splats) -> Result<Option<f64>> {
        ply::write(&self.folder.path().join("model.ply"), splats, &LocalFrame::WORLD)?;
        let surface = evaluate_model(&self.order)?.mean.surface;
        Ok(surface.and_then(|surface| surface.normal_error_deg).map(|error| error.median))
    }
}

/// The model without the spherical harmonics above `sh_degree`.
fn of_degree(splats: &Splats, sh_degree: u32) -> Splats {
    let degree = sh_degree.min(splats.sh_degree);
    let mut cut = Splats::with_capacity(splats.len(), degree);
    for i in 0..splats.len() {
        let sh = &splats.sh_of(i)[..3 * sh_coefficients(degree)];
        cut.push(splats.means[i], splats.quats[i], splats.log_scales[i], splats.opacity_logits[i], sh);
    }
    cut
}

/// Medians of the angle between the normals, degrees, and of the difference of depth, percent, over the pixels that
/// have a depth in both models. NaN if there are no such pixels.
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
