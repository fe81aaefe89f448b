//! `eval-mesh`: scores a mesh against the true surface.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use cosurf_aggregator::evaluate::accuracy::{Accuracy, Score, judge};
use cosurf_scene::{Mesh, atomic, colormap};

use super::arguments::parse_length;

/// Vertices whose error is at least this many times the threshold get the brightest colour.
const BRIGHTEST: f32 = 2.0;
/// Colour of vertices that are not scored, because they lie too far outside the footprint of the true surface.
const CROPPED: [u8; 3] = [128; 3];

/// Score a mesh against the true surface: precision, recall, F-score and mean distances.
///
/// Scores only the part of the mesh that, seen from above (z is up), lies within the footprint of the true surface or a
/// margin around it. The margin is at least as wide as the threshold.
#[derive(Args)]
pub(crate) struct EvalMeshArgs {
    /// Mesh to score, .ply
    mesh: PathBuf,
    /// The true surface, .ply: a mesh or a point cloud; sparse points need normals
    truth: PathBuf,
    /// Largest distance that counts as correct, metres
    #[arg(long, value_name = "M", value_parser = parse_length)]
    threshold: f64,
    /// Also write the mesh to this file, coloured by error: dark for no error, yellow for twice the threshold or more,
    /// grey for parts that are not scored
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print the figures as a line of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &EvalMeshArgs) -> Result<()> {
    args.out.as_deref().map(atomic::check).transpose()?;
    let mut mesh = Mesh::read(&args.mesh)?;
    let mut truth = Mesh::read(&args.truth)?;
    truth.move_origin(mesh.origin);
    let (accuracy, errors_m) = judge(&mesh, &truth, args.threshold, 0)?;
    if let Some(out) = &args.out {
        let most_m = BRIGHTEST * args.threshold as f32;
        let color = |error: f32| if error.is_nan() { CROPPED } else { colormap::ramp(error / most_m) };
        mesh.rgb = errors_m.into_iter().map(color).collect();
        mesh.write(out)?;
    }
    if args.json {
        writeln!(io::stdout(), "{}", serde_json::json!(accuracy))?;
        Ok(())
    } else {
        print(&accuracy)
    }
}

fn print(accuracy: &Accuracy) -> Result<()> {
    let mut stdout = io::stdout().lock();
    writeln!(stdout, "at {} m       precision   recall   F-score", accuracy.threshold_m)?;
    for (name, score) in [("by area", &accuracy.samples), ("by vertices", &accuracy.vertices)] {
        let Score { precision, recall, f_score } = score;
        writeln!(stdout, "{name:12}  {precision:9.4}   {recall:6.4}   {f_score:7.4}")?;
    }
    writeln!(
        stdout,
        "mesh to truth {:.4} m, truth to mesh {:.4} m, chamfer {:.4} m",
        accuracy.mesh_to_truth_m, accuracy.truth_to_mesh_m, accuracy.chamfer_m
    )?;
    let disc = match accuracy.truth_disc_m {
        0.0 => String::new(),
        radius => format!(", each truth point stands for a disc of radius {radius:.3} m"),
    };
    writeln!(
        stdout,
        "{:.1} % of the mesh lies outside the truth's footprint and was not scored; samples {:.3} m apart{disc}",
        100.0 * accuracy.cropped,
        accuracy.sample_spacing_m
    )?;
    Ok(())
}
