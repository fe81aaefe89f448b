//! `mesh`: writes the surface of a model as triangles.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Result, bail, ensure};
use clap::Args;
use cosurf_aggregator::Meter;
use cosurf_aggregator::mesh::{FuseSettings, Fused, MeshSource, decimate, mesh_file, mesh_to_ply};
use cosurf_contract::counted;
use cosurf_scene::bytes::{format_bytes, parse_bytes};
use cosurf_scene::{Dataset, LocalFrame, Mesh, MeshCounts, atomic, model, ply};

use super::arguments::parse_length;
use super::host::display;

/// Make a mesh of a model by rendering its depth from every camera and fusing the depths.
///
/// Needs the cameras, but no photographs. The same model gives the same mesh with any number of threads.
#[derive(Args)]
pub(crate) struct MeshArgs {
    /// The model: a PLY or SPZ file of splats, or the output folder of an agent or a mission
    model: PathBuf,
    /// Dataset whose cameras to render from, or the folder of a model [default: the model's folder]
    #[arg(long, value_name = "DATA")]
    cameras: Option<PathBuf>,
    /// Mesh to write: .ply, .glb, or .obj with the colours of the vertices
    #[arg(long, value_name = "FILE", default_value = "mesh.ply")]
    out: PathBuf,
    /// Reduce the mesh to this many triangles, where it is flat and of one colour first [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    triangles: Option<u32>,
    /// Edge length of a voxel, metres [default: median length that a pixel covers on the surface]
    #[arg(long, value_name = "M", value_parser = parse_length)]
    voxel: Option<f64>,
    /// Memory limit, for example 500MiB; with less, the model is read and the surface fused in several parts. If it is too
    /// small for the mesh, voxels become larger, which a line on standard error reports. A .ply without --triangles needs the
    /// least memory: the mesh is in temporary files beside it until it is finished, which need as much space again on the disk
    #[arg(long, value_name = "BYTES", default_value = "2GiB", value_parser = parse_bytes)]
    memory: u64,
    /// Render pictures whose long side is at most this many pixels [default: the cameras' size]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..))]
    max_size: Option<u32>,
    /// Print progress and result as lines of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &MeshArgs) -> Result<()> {
    if !matches!(args.out.extension().and_then(|e| e.to_str()), Some("ply" | "glb" | "obj")) {
        bail!("{}: name a file that ends in .ply, .glb or .obj", args.out.display());
    }
    atomic::check(&args.out)?;
    let beside = if args.model.is_dir() { Some(&*args.model) } else { args.model.parent() };
    let cameras = args.cameras.as_deref().or(beside).unwrap_or(Path::new(""));
    let mut cameras = Dataset::cameras(cameras)?;
    let frame = LocalFrame::of(cameras.iter());
    cameras.iter_mut().for_each(|camera| *camera = frame.local_camera(camera));
    let model = ply::of_model(&args.model)?;
    if let Some(note) = model::unusable_note(&model) {
        eprintln!("{note}");
    }
    let voxel_m = args.voxel.map(|voxel_m| voxel_m / frame.unit());
    let settings = FuseSettings { voxel_m, memory_bytes: args.memory };
    let threads = available_parallelism().map_or(1, usize::from);
    let begun = Instant::now();
    let mut meter = Meter::new(display(args.json));
    let on_event = |event| {
        meter.show_fusion(event, begun.elapsed().as_secs_f64());
        ControlFlow::Continue(())
    };
    let source = MeshSource { model, frame: &frame, cameras: &cameras, max_size_px: args.max_size };
    let is_streamed = args.triangles.is_none() && args.out.extension().is_some_and(|kind| kind == "ply");
    let fused = if is_streamed {
        mesh_to_ply(&source, &settings, threads, &args.out, on_event)?
    } else {
        let fused = mesh_file(&source, &settings, threads, on_event)?.out_of_frame(&frame);
        fused.try_map(|mesh| write(args, mesh))?
    };
    meter.finish();
    print(args, &fused, begun.elapsed().as_secs_f64())
}

/// Writes a mesh that is in memory, with as many triangles as are asked for.
fn write(args: &MeshArgs, mut mesh: Mesh) -> Result<MeshCounts> {
    if let Some(triangles) = args.triangles {
        mesh = decimate(mesh, triangles as usize);
        ensure!(!mesh.triangles.is_empty(), "no surface is left with {triangles} triangles; ask for more");
    }
    mesh.write(&args.out)?;
    Ok(mesh.counts())
}

fn print(args: &MeshArgs, fused: &Fused<MeshCounts>, seconds: f64) -> Result<()> {
    let Fused { mesh, voxel_m, pixel_m, blocks, parts, peak_bytes } = fused;
    let mut stdout = io::stdout().lock();
    let MeshCounts { vertices, triangles } = *mesh;
    if args.json {
        let line = serde_json::json!({
            "event": "mesh", "vertices": vertices, "triangles": triangles, "voxel_m": voxel_m,
            "pixel_m": pixel_m, "blocks": blocks, "parts": parts, "peak_bytes": peak_bytes, "seconds": seconds,
        });
        writeln!(stdout, "{line}")?;
        return Ok(());
    }
    let (triangles, blocks) = (counted(triangles as usize, "triangle"), counted(*blocks, "block"));
    writeln!(
        stdout,
        "{triangles}, {vertices} vertices in {seconds:.1} s · voxels of {voxel_m:.3} m, a pixel covers {pixel_m:.3} m · {blocks}, {}",
        format_bytes(*peak_bytes)
    )?;
    writeln!(stdout, "{}", args.out.display())?;
    Ok(())
}
