//! `merge`: merges the models of several agents into one.

use std::io::{self, IsTerminal, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Result, ensure};
use clap::Args;
use cosurf_aggregator::gate::{Place, Workspace, admit};
use cosurf_aggregator::georeference::{common_georeference, write_georeference};
use cosurf_aggregator::merge::{
    LocalSummary, Locals, MergeError, MergeProgress, MergeSettings, MergeSummary, MergedFile, ModelSize,
    Resources, Tiles, UNPROVEN_TOLD, Workers, keep_only, merge_to_file,
};
use cosurf_aggregator::queue::Queue;
use cosurf_aggregator::service::{FitRecord, Fitted};
use cosurf_aggregator::store::Store;
use cosurf_contract::counted;
use cosurf_engine::DeviceChoice;
use cosurf_geo::Georeference;
use cosurf_link::Model;
use cosurf_scene::bytes::parse_bytes;
use cosurf_scene::{Camera, FolderLock, LocalFrame, SceneError, camera_list, model, ply};

/// Options that control a merge, shared by the commands `merge` and `mission`.
#[derive(Args)]
pub(super) struct Ways {
    /// Epochs of distillation: how many times the joined model is trained on each camera; 0 joins the models without
    /// distillation
    #[arg(long, value_name = "N", default_value_t = MergeSettings::default().epochs)]
    epochs: u32,
    /// Keep all splats, even where models overlap
    #[arg(long)]
    no_compress: bool,
    /// Leave every model where it is, even if it does not lie exactly on the others; models that lie far off are then
    /// kept out of the merge
    #[arg(long)]
    no_refine: bool,
}

impl Ways {
    /// `vouched` is as in [`MergeSettings`].
    pub(super) fn settings(&self, vouched: bool, memory_bytes: u64, seed: u64) -> MergeSettings {
        let Self { epochs, no_compress, no_refine } = *self;
        MergeSettings {
            epochs,
            compress: !no_compress,
            refine: !no_refine,
            vouched,
            memory_bytes,
            seed,
            ..MergeSettings::default()
        }
    }
}

/// Merge models that agents trained; needs no photographs.
///
/// Where models overlap, keeps only the splats of the model that observed that area best (Local Model Compression). Then
/// trains the joined splats to match what each model renders from its own cameras (Model Aggregation Scheme).
#[derive(Args)]
pub(crate) struct MergeArgs {
    /// Output folders of agents or merges, each with cameras.json and either model.ply or global.ply. Where nothing
    /// else decides between two models, the earlier one is preferred, so another order may give other bytes
    #[arg(required = true, value_name = "FOLDER")]
    models: Vec<PathBuf>,
    /// Output folder for global.ply and cameras.json
    #[arg(long, value_name = "DIR", default_value = "out")]
    out: PathBuf,
    #[command(flatten)]
    ways: Ways,
    /// All models have the same world frame: also merge those that share no ground with the others
    #[arg(long)]
    same_frame: bool,
    /// Limit on the memory of the merge, for example 500MiB
    #[arg(long, value_name = "BYTES", default_value = "4GiB", value_parser = parse_bytes)]
    memory: u64,
    /// Where the tiles of the global model are kept: a folder, or an S3 bucket like s3://bucket/prefix. Of a later merge
    /// with the same place, only those tiles are computed that other models have changed
    #[arg(long, value_name = "DIR|URL")]
    tiles: Option<String>,
    /// Let workers distil the tiles (cosurf-aggregator worker): the NATS server with their queue, for example
    /// nats://10.0.0.1:4222. They need the same tiles
    #[arg(long, value_name = "URL", requires = "tiles")]
    queue: Option<String>,
    /// Seed of every random choice; the same seed gives the same bytes
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Device to compute on: auto (a hardware GPU if there is one, otherwise the CPU), cpu, gpu, or gpu:N with a number
    /// that `cosurf-agent devices` lists. With auto, the CPU is used if the memory limit is too small for the GPU
    #[arg(long = "compute", alias = "device", value_name = "DEVICE", default_value_t)]
    device: DeviceChoice,
    /// Print the figures as a line of JSON
    #[arg(long)]
    json: bool,
}

/// The models of folders, loaded into one frame.
struct Folders<'a> {
    folders: &'a [PathBuf],
    frame: LocalFrame,
    /// Whether each folder tells where on the earth its model lies.
    is_placed: Vec<bool>,
}

impl<'a> Folders<'a> {
    fn open(folders: &'a [PathBuf]) -> Result<Self, SceneError> {
        let frame =
            |folder: &PathBuf| Ok(LocalFrame::of(camera_list::read(&folder.join(camera_list::FILE))?.iter()));
        let frames = folders.iter().map(frame).collect::<Result<Vec<_>, SceneError>>()?;
        let is_placed = folders.iter().map(|folder| folder.join(Georeference::FILE).is_file()).collect();
        Ok(Self { folders, frame: LocalFrame::most_common(&frames), is_placed })
    }
}

impl Locals for Folders<'_> {
    fn count(&self) -> usize {
        self.folders.len()
    }

    fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
        let (splats, sh_degree) = model::size(&ply::of_model(&self.folders[index])?)?;
        Ok(ModelSize { splats, sh_degree })
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        let folder = &self.folders[index];
        let splats = model::read(&ply::of_model(folder)?, &self.frame)?;
        let cameras = camera_list::read(&folder.join(camera_list::FILE))?;
        let cameras = cameras.iter().map(|camera| self.frame.local_camera(camera)).collect();
        Ok(Model { splats, cameras })
    }

    fn is_placed(&self, index: usize) -> bool {
        self.is_placed[index]
    }
}

pub(crate) fn run(args: &MergeArgs) -> Result<()> {
    let _lock = FolderLock::take(&args.out, "cosurf-aggregator merge")?;
    ensure!(
        !args.out.join("model.ply").exists(),
        "{}: holds the model of a training, whose cameras.json would be replaced; choose another --out",
        args.out.display()
    );
    for folder in &args.models {
        if let Some(note) = model::unusable_note(&ply::of_model(folder)?) {
            eprintln!("{note}");
        }
    }
    let settings =
        MergeSettings { device: args.device, ..args.ways.settings(args.same_frame, args.memory, args.seed) };
    let threads = available_parallelism().map_or(1, usize::from);
    let begun = Instant::now();
    let (say, troubles) = mpsc::channel();
    let mut tell = |progress| {
        // Write errors are ignored: the merge goes on.
        troubles.try_iter().for_each(|trouble| drop(writeln!(io::stderr(), "{trouble}")));
        show(&progress);
        ControlFlow::Continue(())
    };
    let results = args.tiles.as_deref().map(Store::open).transpose()?;
    let queue = args.queue.as_deref().map(Queue::open).transpose()?;
    let tiles = match (&results, &queue) {
        (Some(store), Some(queue)) => {
            Tiles::ByWorkers(Workers { store, queue, patience: Workers::PATIENCE, say: &say })
        }
        (Some(store), None) => Tiles::Kept(store),
        (None, _) => Tiles::Forgotten,
    };
    let resources = Resources { scratch: &args.out, tiles, threads };
    let georeference = common_georeference(&args.models)?;
    let folders = Folders::open(&args.models)?;
    let names: Vec<String> = args.models.iter().map(|folder| folder.display().to_string()).collect();
    let workspace = Workspace::of(&settings, &args.out, threads);
    let admitted = admit(&folders, (&settings).into(), workspace, &|| false)
        .map_err(|error| named(error, |local| &names[local]))?;
    let kept_out: Vec<String> =
        admitted.kept_out(&names).map(|(i, why)| format!("{} {why}", names[i])).collect();
    ensure!(admitted.count() > 0, "nothing to merge: {}", kept_out.join("; "));
    let merged = merge_to_file(&admitted, &settings, resources, &mut tell)
        .map_err(|error| named(error, |local| &names[admitted.place(local).local]))?;
    write(&args.out, &merged, &folders.frame)?;
    write_georeference(georeference.as_ref(), &args.out)?;
    if let Some(results) = &results {
        keep_only(results, &merged.tiles)?;
    }
    let seconds = begun.elapsed().as_secs_f64();
    let mut stdout = io::stdout().lock();
    if args.json {
        let places = (0..admitted.count()).map(|place| admitted.place(place));
        let fitted: Vec<Fitted> =
            places.filter_map(|place| Fitted::of(&names[place.local], place, &folders.frame)).collect();
        let fits: Vec<FitRecord> = admitted.fits().iter().map(|fit| FitRecord::of(&names, fit)).collect();
        let line = serde_json::json!({
            "seconds": seconds,
            "merge": merged.summary,
            "kept_out": kept_out,
            "fitted": fitted,
            "fits": fits,
        });
        writeln!(stdout, "{line}")?;
        return Ok(());
    }
    let unit = folders.frame.unit();
    for (place, local) in merged.summary.locals.iter().enumerate() {
        let LocalSummary { arrived, overlap, removed, unproven, .. } = local;
        let Place { local, trust, size, is_verified, void, by, tone } = admitted.place(place);
        let (folder, percent) = (&names[local], 100.0 * overlap);
        let (arrived, removed) = (counted(*arrived, "splat"), counted(*removed, "splat"));
        let moved = by
            .map(|by| format!(", moved by {:.2} m to where it fits", by.distance_m * unit))
            .unwrap_or_default();
        let toned = tone.map(|tone| format!(", {tone}")).unwrap_or_default();
        let weight = if trust.weight < 1.0 {
            format!(", counts {:.0} % because it differs from the others", 100.0 * trust.weight)
        } else {
            String::new()
        };
        let size = if size < 1.0 {
            format!(", shows no more detail than pictures {:.0} % as large, and counts as such", 100.0 * size)
        } else {
            String::new()
        };
        let void = match void {
            0.0 => String::new(),
            void => format!(", shows no ground in {:.0} % of the pictures of its own cameras", 100.0 * void),
        };
        let unproven = match unproven {
            few if *few < UNPROVEN_TOLD => String::new(),
            share => format!(
                ", has few splats where {:.0} % of its cameras look, which do not count",
                100.0 * share
            ),
        };
        let is_linked = admitted.fits().iter().any(|fit| fit.models.contains(&local));
        let apart = match settings.refine && admitted.count() > 1 && is_verified && !is_linked {
            true => ", could not be fitted to the others and may lie apart from them",
            false => "",
        };
        let unverified = if is_verified { "" } else { ", shares no ground with the others" };
        writeln!(
            stdout,
            "{folder}: {arrived}, {percent:.0} % on shared ground, {removed} removed{moved}{toned}{weight}{size}{void}{unproven}{unverified}{apart}"
        )?;
    }
    kept_out.iter().try_for_each(|kept_out| writeln!(stdout, "kept out: {kept_out}"))?;
    let MergeSummary { joined, splats, steps, tiles, known_tiles, device, .. } = merged.summary;
    let (joined, steps) = (counted(joined, "splat"), counted(steps, "step"));
    if known_tiles > 0 {
        writeln!(stdout, "{known_tiles} of {} had not changed", counted(tiles, "tile"))?;
    }
    writeln!(stdout, "{joined} joined, {splats} after {steps}, in {seconds:.1} s ({device})")?;
    writeln!(stdout, "{}", args.out.join("global.ply").display())?;
    Ok(())
}

/// The error, with the names of the models that it is about. `name` has that of the model at an index.
fn named<'a>(error: MergeError, name: impl Fn(usize) -> &'a String) -> anyhow::Error {
    let whose = match &error {
        MergeError::PicturesTooLarge { locals, .. } | MergeError::ModelsTooLarge { locals, .. } => {
            locals.iter().map(|local| name(*local).as_str()).collect::<Vec<_>>().join(", ")
        }
        _ => return error.into(),
    };
    anyhow::Error::from(error).context(whose)
}

/// Writes the global model, which is in `frame`, and its world cameras.
fn write(out: &Path, merged: &MergedFile, frame: &LocalFrame) -> Result<()> {
    let MergedFile { splats, cameras, .. } = merged;
    let cameras: Vec<Camera> = cameras.iter().map(|camera| frame.world_camera(camera)).collect();
    let parts = splats.parts().map(|part| part.map_err(io::Error::other));
    ply::write_parts(&out.join("global.ply"), splats.len(), splats.sh_degree(), frame, parts)?;
    camera_list::write(&out.join(camera_list::FILE), &cameras)?;
    Ok(())
}

/// Redraws the progress line on a terminal; prints nothing elsewhere.
fn show(progress: &MergeProgress) {
    let mut stderr = io::stderr().lock();
    if stderr.is_terminal() {
        let MergeProgress { step, steps, psnr } = progress;
        let psnr = psnr.map_or_else(String::new, |psnr| format!("· {psnr:.2} dB "));
        let _ = write!(stderr, "\rstep {step} of {steps} {psnr}"); // write errors are ignored: the merge goes on
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Pose, Splats};
    use glam::{DVec2, DVec3};

    use super::*;

    #[test]
    fn cameras_without_pixels_or_focal_lengths_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let mut splats = Splats::with_capacity(1, 0);
        splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [0.0; 3], 1.0, &[0.5; 3]);
        ply::write(&folder.path().join("model.ply"), &splats, &LocalFrame::WORLD).unwrap();
        let camera = Camera {
            cam_from_world: Pose::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(10.0),
            center_px: DVec2::splat(5.0),
            size_px: [10, 10],
        };
        let load = |second: Camera| {
            let text = serde_json::to_vec(&[camera, second]).unwrap();
            std::fs::write(folder.path().join("cameras.json"), text).unwrap();
            let folders = [folder.path().to_owned()];
            let opened = Folders::open(&folders).map_err(|error| error.to_string())?;
            opened.load(0).map_err(|error| error.to_string())
        };
        assert!(load(camera).is_ok_and(|model| model.cameras.len() == 2));
        for blind in [
            Camera { size_px: [0, 10], ..camera },
            Camera { focal_px: DVec2::new(-1.0, 10.0), ..camera },
            Camera { focal_px: DVec2::ZERO, ..camera },
        ] {
            let error = load(blind).unwrap_err();
            assert!(error.contains("cameras.json") && error.contains("camera 1 has no pixels"), "{error}");
        }
    }
}
