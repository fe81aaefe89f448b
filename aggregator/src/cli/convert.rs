//! `convert`: writes a model in another file format.

mod viewer_cameras;

use std::f64::consts::FRAC_PI_2;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, ValueEnum};
use cosurf_contract::counted;
use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_scene::bytes::{format_bytes, parse_bytes};
use cosurf_scene::{Camera, Dataset, LocalFrame, SceneError, Splats, atomic, model, ply, spz, turn};
use glam::{DQuat, DVec3};

/// Splats that are in memory at a time. A model is read in such parts, once for each column of an SPZ, so that it may be larger
/// than the memory.
const READ_AT_ONCE: usize = 4096;
/// Upper bound on the memory for reading, packing and compressing, bytes. With it, converting may take 40 MiB; 2 million splats
/// took 28.
const WORK_BYTES: u64 = 12 << 20;

/// Convert a model between PLY and SPZ; the extension of the file to write selects its format.
///
/// Reads the PLY of 3DGS, the compressed PLY of SuperSplat, and SPZ. SPZ is about ten times smaller than PLY because it
/// quantises the splats; use it for viewers. The axes are converted as in other tools, so that viewers show both files
/// alike.
#[derive(Args)]
pub(crate) struct ConvertArgs {
    /// Model to read: .ply, compressed .ply, or .spz of version 1 to 4; or the folder of a training, a merge or a mission
    model: PathBuf,
    /// File to write: .ply or .spz
    out: PathBuf,
    /// Version of the .spz to write: most viewers read 3, old ones only 2, and new tools 4, which is a little smaller
    #[arg(long, value_name = "VERSION", default_value = "3", value_parser = parse_version)]
    spz_version: spz::Version,
    /// Turn the model: `y` so that a world with z up stands upright in viewers; `z` turns such a file back
    #[arg(long, value_name = "AXIS")]
    up: Option<Up>,
    /// Also write the model's cameras.json in the format of 3DGS, turned like the model, for viewers such as SuperSplat
    #[arg(long, value_name = "FILE.json")]
    viewer_cameras: Option<PathBuf>,
    /// Limit on resident memory, for example 300MiB [default: no limit]
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes)]
    memory: Option<u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Up {
    /// For viewers
    Y,
    /// Of the world
    Z,
}

impl Up {
    /// The rotation that gives a model this axis. Viewers take the PLY of 3DGS to have y down, and SPZ, whose y is that of
    /// PLY with the other sign, to have y up.
    fn rotation(self) -> DQuat {
        match self {
            Self::Y => DQuat::from_rotation_x(FRAC_PI_2),
            Self::Z => DQuat::from_rotation_x(-FRAC_PI_2),
        }
    }
}

fn parse_version(text: &str) -> Result<spz::Version, String> {
    match text {
        "2" => Ok(spz::Version::V2),
        "3" => Ok(spz::Version::V3),
        "4" => Ok(spz::Version::V4),
        _ => Err("versions 2, 3 and 4 are written".into()),
    }
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
    let (path, to) = (ply::of_model(&args.model)?, Format::of(&args.out)?);
    atomic::check(&args.out)?;
    args.viewer_cameras.as_deref().map(atomic::check).transpose()?;
    check_memory(args.memory)?;
    let origin = model::origin(&path)?;
    let cameras = args.viewer_cameras.as_ref().map(|_| cameras(&path, origin)).transpose()?;
    if let Some(note) = model::unusable_note(&path) {
        eprintln!("{note}");
    }
    let rotation = args.up.map(Up::rotation);
    if origin != DVec3::ZERO && (matches!(to, Format::Spz) || rotation.is_some()) {
        eprintln!(
            "positions are relative to {} {} {} of the world, which {} cannot hold: keep it",
            origin.x,
            origin.y,
            origin.z,
            if rotation.is_some() { "a turned model" } else { "an SPZ" }
        );
    }
    let model = Model { path, frame: LocalFrame::at(origin), rotation };
    let (mut splats, mut resized) = (0, 0);
    model.read(&mut |part| {
        splats += part.len();
        resized += spz::resized(part);
    })?;
    if matches!(to, Format::Spz) {
        tell_resized(resized, splats);
    }
    match to {
        Format::Ply => model.write_ply(&args.out, splats),
        Format::Spz => model.write_spz(&args.out, args.spz_version),
    }
    .with_context(|| format!("cannot write {}", counted(splats, "splat")))?;
    if let (Some(out), Some(cameras)) = (&args.viewer_cameras, cameras) {
        viewer_cameras::write(out, &cameras, rotation.unwrap_or(DQuat::IDENTITY))?;
    }
    Ok(())
}

/// A model in a file, and how it is turned.
struct Model {
    path: PathBuf,
    frame: LocalFrame,
    rotation: Option<DQuat>,
}

impl Model {
    /// Calls `visit` with a few splats at a time.
    fn read(&self, visit: &mut dyn FnMut(&Splats)) -> Result<(), SceneError> {
        model::read_parts(&self.path, &self.frame, READ_AT_ONCE, |part| match self.rotation {
            None => visit(part),
            Some(rotation) => {
                let mut turned = part.clone();
                turn::turn(&mut turned, rotation);
                visit(&turned);
            }
        })
    }

    fn write_ply(&self, out: &Path, splats: usize) -> Result<(), SceneError> {
        let sh_degree = model::size(&self.path)?.1;
        // The origin belongs to the axes of the world.
        let frame = if self.rotation.is_none() { &self.frame } else { &LocalFrame::WORLD };
        ply::write_with(out, splats, sh_degree, frame, |write| {
            let mut written = Ok(());
            let mut visit = |part: &Splats| {
                if written.is_ok() {
                    written = write(part);
                }
            };
            self.read(&mut visit).map_err(io::Error::other)?;
            written
        })
    }

    fn write_spz(&self, out: &Path, version: spz::Version) -> Result<(), SceneError> {
        spz::write_with(out, model::size(&self.path)?.1, version, &|visit| self.read(visit))
    }
}

/// Tells the user if an SPZ changes the size of many splats: then the model has an unusual unit.
fn tell_resized(resized: usize, of: usize) {
    if resized * 100 > of {
        eprintln!(
            "{resized} of {of} splats are smaller or larger than SPZ can hold, and look different in it: write a PLY, or give \
             the dataset another unit of length"
        );
    }
}

/// The cameras beside a model, relative to the model's origin.
fn cameras(model: &Path, origin: DVec3) -> Result<Vec<Camera>> {
    let beside = model.parent().unwrap_or(Path::new(""));
    let cameras = Dataset::cameras(beside).context("the cameras are read from the folder of the model")?;
    let frame = LocalFrame::at(origin);
    Ok(cameras.iter().map(|camera| frame.local_camera(camera)).collect())
}

/// Fails if converting takes more memory than allowed. The size of the model does not matter.
fn check_memory(memory_bytes: Option<u64>) -> Result<()> {
    let needed_bytes = PROCESS_BYTES + WORK_BYTES;
    ensure!(
        memory_bytes.is_none_or(|memory_bytes| needed_bytes <= memory_bytes),
        "--memory: give at least {}",
        format_bytes(needed_bytes)
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viewers_show_a_world_upright() {
        // In a PLY of 3DGS, x is right, y down and z forward.
        let rotation = Up::Y.rotation();
        assert!((rotation * DVec3::Z - DVec3::NEG_Y).length() < 1e-12, "up is up");
        assert!((rotation * DVec3::Y - DVec3::Z).length() < 1e-12, "north is forward");
        assert!((rotation * Up::Z.rotation() * DVec3::ONE - DVec3::ONE).length() < 1e-12);
    }
}
