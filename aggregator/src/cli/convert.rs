//! `convert`: writes a model in another file format.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use cosurf_contract::counted;
use cosurf_scene::{Splats, ply, spz};

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
    let to = Format::of(&args.out)?;
    let splats: Splats = match Format::of(&args.model)? {
        Format::Ply => ply::read(&args.model)?,
        Format::Spz => spz::read(&args.model)?,
    };
    match to {
        Format::Ply => ply::write(&args.out, &splats),
        Format::Spz => spz::write(&args.out, &splats),
    }
    .with_context(|| format!("cannot write {}", counted(splats.len(), "splat")))
}
