//! `convert`: writes a model in another file format.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use cosurf_contract::counted;
use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_scene::bytes::{format_bytes, parse_bytes};
use cosurf_scene::{LocalFrame, Splats, ply, spz};
use glam::DVec3;

/// Convert a model between PLY and SPZ; the file extensions select the formats.
///
/// SPZ is about ten times smaller because it quantises the splats; use it for viewers. The axes are converted as in
/// other tools, so that viewers show both files alike.
#[derive(Args)]
pub(crate) struct ConvertArgs {
    /// Model to read: .ply, or .spz of version 2 or 3
    model: PathBuf,
    /// File to write: .ply or .spz
    out: PathBuf,
    /// Limit on resident memory, for example 300MiB [default: no limit]
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes)]
    memory: Option<u64>,
}

enum Format {
    Ply,
    Spz,
}

impl Format {
    fn of(path: &Path) -> Result<Self> {
        let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
        match extension.as_ref().and_then(|extension| extension.to_str()) {
            Some("ply") => Ok(Self::Ply),
            Some("spz") => Ok(Self::Spz),
            _ => bail!("{}: name a file that ends in .ply or .spz", path.display()),
        }
    }
}

pub(crate) fn run(args: &ConvertArgs) -> Result<()> {
    let (from, to) = (Format::of(&args.model)?, Format::of(&args.out)?);
    if let Some(memory_bytes) = args.memory {
        check_memory(&args.model, &from, memory_bytes)?;
    }
    let origin = match from {
        Format::Ply => ply::origin(&args.model)?,
        Format::Spz => DVec3::ZERO,
    };
    let frame = LocalFrame::at(origin);
    let splats: Splats = match from {
        Format::Ply => ply::read(&args.model, &frame)?,
        Format::Spz => spz::read(&args.model)?,
    };
    if matches!(to, Format::Spz) && origin != DVec3::ZERO {
        eprintln!(
            "positions are relative to {} {} {}, which an SPZ cannot hold: keep it",
            origin.x, origin.y, origin.z
        );
    }
    match to {
        Format::Ply => ply::write(&args.out, &splats, &frame),
        Format::Spz => spz::write(&args.out, &splats),
    }
    .with_context(|| format!("cannot write {}", counted(splats.len(), "splat")))
}

/// Fails if the splats, and those of an SPZ before compression, take more memory than allowed.
fn check_memory(model: &Path, format: &Format, memory_bytes: u64) -> Result<()> {
    let (splats, sh_degree) = match format {
        Format::Ply => ply::size(model)?,
        Format::Spz => spz::size(model)?,
    };
    let per_splat = Splats::bytes_per_splat(sh_degree) + spz::body_bytes(sh_degree);
    let needed_bytes = PROCESS_BYTES + (splats * per_splat) as u64;
    ensure!(
        needed_bytes <= memory_bytes,
        "{}: {} need --memory {}MiB instead of {}",
        model.display(),
        counted(splats as u64, "splat"),
        needed_bytes.div_ceil(1 << 20),
        format_bytes(memory_bytes)
    );
    Ok(())
}
