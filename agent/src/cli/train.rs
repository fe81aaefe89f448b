//! `train`: trains a model from a dataset.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use cosurf_agent::checkpoint::{self, Checkpoint, DamagedCheckpoint, OtherTraining, Spent};
use cosurf_agent::session::{Session, Split, TrainPlan};
use cosurf_agent::{evaluate, outputs};
use cosurf_contract::{AgentEvent, Curve, DEFAULT_STEPS, ReadyReport, Share, TrainReport, counted, usage};
use cosurf_engine::{
    Backend, DeviceChoice, DeviceLost, PoseChoice, PruneScore, PruneSettings, Renderer, SurfaceSettings,
};
use cosurf_scene::bytes::{format_bytes, parse_bytes};
use cosurf_scene::{Camera, Dataset, FolderLock, check_space, files, model};
use tracing::info_span;

use super::arguments::{Common, DeviceArgs};
use super::curve::GrowingCurve;
use super::host::default_memory;
use super::paths::resolve_init;
use super::progress::Progress;
use super::stop::Stoppable;

/// Time between two attempts to write to a full disk.
const FULL_DISK_WAIT: Duration = Duration::from_secs(5);
/// Largest share of the time that checkpoints take, judged by the last one. On a graphics card one may take as long as a
/// hundred steps.
const CHECKPOINT_SHARE: f64 = 0.05;

/// After so many steps, a model of pictures with their poses shows other views of the scene better than plain colours do.
const STEPS_TO_LEARN: u32 = 100;

/// What a training needs on the disk at least for each splat that it begins with, bytes: a checkpoint, and the next one
/// before it replaces the first; each has 59 parameters of a splat and two moments of each.
const BYTES_PER_SPLAT: u64 = 2 * 59 * 3 * 4;

/// Train a model from a dataset: COLMAP (`sparse/0` with `images`), `transforms.json`, `reconstruction.json` of OpenSfM, or an
/// export of Metashape or RealityCapture.
///
/// Writes DIR/model.ply, DIR/cameras.json, DIR/report.json and DIR/checkpoint/. To resume after a stop or a kill,
/// run the same command again.
#[derive(Args, Debug)]
pub(super) struct TrainArgs {
    /// The dataset's folder
    data: PathBuf,
    /// The folder to write to
    #[arg(long, value_name = "DIR", default_value = "out/model")]
    out: PathBuf,
    /// Training steps
    #[arg(long, value_name = "N", default_value_t = DEFAULT_STEPS, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Limit on resident memory, for example 300MiB [default: two thirds of the free memory, at most 8 GiB]
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes)]
    memory: Option<u64>,
    /// Seed of all random numbers; the same seed gives the same bytes
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Hold out every n-th view by sorted name, to score the model; 0 holds out none
    #[arg(long, value_name = "N", default_value_t = 8)]
    eval_every: u32,
    /// Train colour only, without the surface losses: faster, but depth and normals are not accurate
    #[arg(long)]
    color_only: bool,
    /// The model will be merged with others, as those of `run` are: it gets more splats, and keeps what only one picture shows
    #[arg(long)]
    for_merge: bool,
    /// Train with the paper's settings (CoSurfGS): its weights of the surface losses, patches of 7 × 7 pixels, and its pruning of
    /// 0.2 of the splats. For comparisons
    #[arg(long, conflicts_with_all = ["color_only", "prune", "prune_at", "prune_score"])]
    paper: bool,
    /// Share of the splats to prune; the least important splats are removed, 0 removes none
    #[arg(long, value_name = "SHARE", default_value_t = default_prune())]
    prune: Share,
    /// Prune after this share of the steps [default: two thirds]
    #[arg(long, value_name = "SHARE")]
    prune_at: Option<Share>,
    /// Formula for the importance of a splat
    #[arg(long, value_name = "SCORE", default_value = "corrected")]
    prune_score: ScoreArg,
    /// Learn an exposure for each picture, for cameras with automatic exposure
    #[arg(long)]
    exposure: bool,
    /// Poses of the pictures: `fixed` takes them as exact, `learn` corrects them while it trains, `auto` does so if they turn
    /// out not to be exact
    #[arg(long, value_name = "WAY", default_value_t)]
    poses: PoseChoice,
    /// Start from this earlier model of the ground in the pictures instead of from the sparse cloud: a PLY or SPZ file, or the
    /// folder of a training, a merge or a mission. The word `global` stands for the global model that was received earlier and
    /// stored in the folder of --out. A training that resumes does not start from it again
    #[arg(long, value_name = "MODEL")]
    init: Option<PathBuf>,
    /// Start again even if DIR has a checkpoint
    #[arg(long)]
    fresh: bool,
    #[command(flatten)]
    device: DeviceArgs,
    #[command(flatten)]
    common: Common,
}

/// The values of `--prune-score`; see [`PruneScore`].
#[derive(Clone, Copy, Debug, ValueEnum)]
enum ScoreArg {
    /// Squared blending weights of the splat, summed over all pixels of all views, times a factor for its area
    Corrected,
    /// Formula of the CoSurfGS paper: number of pixels that the splat hits in all views, times its opacity, times a
    /// factor for its volume
    Paper,
}

fn default_prune() -> Share {
    Share::try_from(PruneSettings::default().ratio).expect("the default is a share")
}

impl TrainArgs {
    fn surface(&self) -> Option<SurfaceSettings> {
        let settings = if self.paper { SurfaceSettings::paper() } else { SurfaceSettings::default() };
        (!self.color_only).then_some(settings)
    }

    fn prune(&self) -> Option<PruneSettings> {
        if self.paper {
            return Some(PruneSettings::paper());
        }
        let score = match self.prune_score {
            ScoreArg::Corrected => PruneScore::Corrected,
            ScoreArg::Paper => PruneScore::Paper,
        };
        let (ratio, at) = (self.prune.get(), self.prune_at.map_or(PruneSettings::default().at, Share::get));
        (ratio > 0.0).then_some(PruneSettings { ratio, at, score })
    }
}

pub(super) fn run(args: &TrainArgs) -> Result<()> {
    let _lock = FolderLock::take(&args.out, "cosurf-agent train")?;
    let plan = TrainPlan {
        data: args.data.clone(),
        split: Split::Every(args.eval_every),
        steps: args.steps,
        seed: args.seed,
        memory_bytes: args.memory.unwrap_or_else(default_memory),
        max_size_px: args.common.max_size_px(),
        device: args.device.device,
        threads: args.common.threads(),
        surface: args.surface(),
        prune: args.prune(),
        exposure: args.exposure,
        poses: args.poses,
        init: resolve_init(args.init.as_ref(), &args.out),
        one_of_many: args.for_merge,
    };
    let mut progress = Progress::new(args.common.json);
    let report = train(&plan, &args.out, Start::attended(args.fresh), &mut progress)?;
    if args.common.json { Ok(()) } else { print_report(&report, &args.out) }
}

/// What a training does with a checkpoint that is there.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Start {
    /// It goes on from the checkpoint. One of another training is an error: the user decides.
    Resumed,
    /// It goes on from the checkpoint. One of another training is set aside, because nobody is there to decide.
    Unattended,
    /// It ignores the checkpoint.
    Fresh,
}

impl Start {
    /// The start of a command that somebody gave, with or without `--fresh`.
    pub(super) fn attended(fresh: bool) -> Self {
        if fresh { Self::Fresh } else { Self::Resumed }
    }

    /// Whether a training sets the checkpoint aside and starts again after this error.
    fn sets_aside_after(self, error: &anyhow::Error) -> bool {
        error.is::<DamagedCheckpoint>() || (self == Self::Unattended && error.is::<OtherTraining>())
    }
}

/// Trains with checkpoints and writes all results into the existing folder `out`. A damaged checkpoint is set aside, and
/// training starts again. If the plan's device is `auto` and the GPU is lost, training resumes on the CPU from the
/// checkpoint in `out`, or starts again if there is none.
pub(super) fn train(
    plan: &TrainPlan,
    out: &Path,
    start: Start,
    progress: &mut Progress,
) -> Result<TrainReport> {
    checkpoint::make_folder(out)?;
    Dataset::notes(&plan.data).iter().for_each(|note| eprintln!("{note}"));
    outputs::take_over_place(&plan.data, out)?;
    if let Some(note) = plan.init.as_deref().and_then(model::unusable_note) {
        eprintln!("{note}");
    }
    match train_on_any(plan, out, start != Start::Fresh, progress) {
        Err(error) if start.sets_aside_after(&error) => {
            let kept = checkpoint::set_aside(out)?;
            progress.show(&AgentEvent::CheckpointSetAside { reason: format!("{error:#}"), kept });
            train_on_any(plan, out, false, progress)
        }
        report => report,
    }
}

fn train_on_any(
    plan: &TrainPlan,
    out: &Path,
    mut resumes: bool,
    progress: &mut Progress,
) -> Result<TrainReport> {
    match train_on(plan, out, &mut resumes, progress) {
        Err(error) if plan.device == DeviceChoice::Auto && error.is::<DeviceLost>() => {
            progress.show(&AgentEvent::DeviceLost { reason: format!("{error:#}") });
            let plan = TrainPlan { device: DeviceChoice::Cpu, ..plan.clone() };
            train_on(&plan, out, &mut resumes, progress)
        }
        report => report,
    }
}

/// Prepares a training as far as its first step: reads the dataset, plans the memory, opens the device, and checks the disk
/// of the folder `out`.
pub(super) fn prepare(plan: &TrainPlan, out: &Path) -> Result<ReadyReport> {
    let session = Session::start(plan, None)?;
    check_disk(&session, out)?;
    let backend = session.trainer().backend();
    Ok(ReadyReport {
        views: session.cameras().len(),
        held_out: session.held_out().len(),
        splats: backend.len(),
        size_px: session.size_px(),
        device: backend.device(),
        given_up: session.given_up(),
    })
}

/// Fails if the disk has too little room for the checkpoints.
fn check_disk(session: &Session, out: &Path) -> Result<()> {
    Ok(check_space(out, BYTES_PER_SPLAT * session.trainer().backend().len() as u64)?)
}

/// Trains on the plan's device. `resumes` tells whether the checkpoint in `out` counts; it becomes true with the first
/// checkpoint that this training writes.
fn train_on(
    plan: &TrainPlan,
    out: &Path,
    resumes: &mut bool,
    progress: &mut Progress,
) -> Result<TrainReport> {
    let found = if *resumes { Checkpoint::find(out)? } else { None };
    let before = found.as_ref().map(Checkpoint::spent).unwrap_or_default();
    let curve = found.as_ref().map(Checkpoint::curve).unwrap_or_default();
    let mut curve = GrowingCurve::on(curve, plan.steps);
    let mut session = Session::start(plan, found)?;
    session.notes().iter().for_each(|note| eprintln!("{note}"));
    check_disk(&session, out)?;
    let (started, cpu_s) = (Instant::now(), usage::cpu_seconds());
    let spent = || Spent {
        seconds: before.seconds + started.elapsed().as_secs_f64(),
        cpu_seconds: before.cpu_seconds + usage::cpu_seconds() - cpu_s,
    };
    let stoppable = Stoppable::begin();
    progress.show(&AgentEvent::Started {
        views: session.cameras().len(),
        held_out: session.held_out().len(),
        splats: session.trainer().backend().len(),
        steps: plan.steps,
        resumed_at: session.trainer().steps_done(),
    });
    let span = info_span!("train", steps = plan.steps).entered();
    let checkpoint_every = (plan.steps / 10).clamp(100, 1000);
    let (mut saved_at, mut saving, mut full_disks) = (Instant::now(), Duration::ZERO, 0);
    while !session.trainer().is_done() {
        let outcome = session.step()?;
        let steps_done = session.trainer().steps_done();
        curve.step(steps_done, outcome.loss.psnr());
        progress.step(steps_done, plan.steps, &outcome, session.trainer().backend().len());
        let is_due = steps_done.is_multiple_of(checkpoint_every)
            && saved_at.elapsed().mul_f64(CHECKPOINT_SHARE) >= saving;
        if is_due && !session.trainer().is_done() {
            let start = Instant::now();
            match checkpoint::write(out, session.fingerprint(), session.trainer(), spent(), curve.curve()) {
                // The training goes on; the next checkpoint may fit.
                Err(error) if is_full_disk(&error) => {
                    full_disks += 1;
                    progress
                        .show(&AgentEvent::Retrying { reason: format!("{error:#}"), attempt: full_disks });
                }
                written => {
                    written?;
                    *resumes = true;
                }
            }
            (saved_at, saving) = (Instant::now(), start.elapsed());
        }
        if stoppable.is_asked() && !session.trainer().is_done() {
            checkpoint::write(out, session.fingerprint(), session.trainer(), spent(), curve.curve())?;
            bail!("stopped at step {steps_done} of {}; run the same command again to go on", plan.steps);
        }
    }
    drop((span, stoppable));
    let spent = spent();
    until_room(progress, || {
        checkpoint::write(out, session.fingerprint(), session.trainer(), spent, curve.curve())
    })?;
    let report = finish(plan, session, out, spent, curve.curve(), progress)?;
    progress.show(&AgentEvent::Trained { report: report.clone() });
    Ok(report)
}

/// Writes, again and again while the disk is full.
fn until_room(progress: &mut Progress, mut write: impl FnMut() -> Result<()>) -> Result<()> {
    let mut attempt = 0;
    loop {
        match write() {
            Err(error) if is_full_disk(&error) => {
                attempt += 1;
                progress.show(&AgentEvent::Retrying { reason: format!("{error:#}"), attempt });
                thread::sleep(FULL_DISK_WAIT);
            }
            result => return result,
        }
    }
}

fn is_full_disk(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(files::is_full_disk)
}

/// Scores the trained model on the held-out views, and writes model, cameras and report into `out`.
fn finish(
    plan: &TrainPlan,
    session: Session,
    out: &Path,
    spent: Spent,
    curve: &Curve,
    progress: &mut Progress,
) -> Result<TrainReport> {
    let (given_up, shrinking) = (session.given_up(), session.shrinking());
    let (frame, cameras, held_out, size_px) =
        (session.frame(), session.cameras(), session.held_out().to_vec(), session.size_px());
    let device = session.trainer().backend().device();
    let extent = session.trainer().settings().extent;
    let poses = session.trainer().poses_found().filter(|found| found.learnt);
    // Frees the optimiser's memory before the renderer allocates its own.
    let model = session.into_model()?;
    if model.in_training().is_empty() {
        bail!(
            "{}: nothing was learnt, no splat is left; check that the poses belong to the pictures",
            plan.data.display()
        );
    }
    let mut renderer = Renderer::new(model.in_training(), plan.threads);
    let long_side_px = size_px[0].max(size_px[1]);
    let render = |camera: &Camera| Ok(renderer.render(camera));
    let score = evaluate::score(render, &held_out, long_side_px, shrinking, poses.map(|_| extent))?;
    drop(renderer);
    let splats = model.into_splats();
    let report = TrainReport {
        steps: plan.steps,
        seconds: spent.seconds,
        cpu_seconds: spent.cpu_seconds,
        steps_per_s: f64::from(plan.steps) / spent.seconds.max(1e-9),
        splats: splats.len(),
        peak_memory_bytes: usage::peak_bytes(),
        psnr: score.psnr,
        ssim: score.ssim,
        seed: plan.seed,
        device,
        views: cameras.len(),
        held_out: held_out.len(),
        size_px,
        poses_moved_px: poses.map(|found| found.median_px),
        given_up,
        curve: curve.clone(),
    };
    until_room(progress, || outputs::write(out, &splats, &cameras, &frame, &report))?;
    if plan.steps >= STEPS_TO_LEARN && score.shows_nothing() {
        bail!(
            "{}: nothing was learnt, the model shows pictures that were held out no better than one plain colour would \
             ({:.1} dB); check that the poses belong to the pictures. The model is in {}",
            plan.data.display(),
            score.psnr.unwrap_or(0.0),
            out.display()
        );
    }
    Ok(report)
}

fn print_report(report: &TrainReport, out: &Path) -> Result<()> {
    let mut stdout = io::stdout().lock();
    writeln!(
        stdout,
        "{} after {} in {:.1} s ({:.1} steps/s, {}), peak memory {}",
        counted(report.splats as u64, "splat"),
        counted(report.steps, "step"),
        report.seconds,
        report.steps_per_s,
        report.device,
        format_bytes(report.peak_memory_bytes)
    )?;
    if let (Some(psnr), Some(ssim)) = (report.psnr, report.ssim) {
        writeln!(
            stdout,
            "{}: PSNR {psnr:.2} dB, SSIM {ssim:.4}",
            counted(report.held_out as u64, "held-out view")
        )?;
    }
    if let Some(moved_px) = report.poses_moved_px {
        writeln!(
            stdout,
            "the poses were not exact and have been corrected: half of the pictures moved by {moved_px:.1} px or more"
        )?;
    }
    for given_up in &report.given_up {
        writeln!(stdout, "reduced to fit the memory: {given_up}")?;
    }
    writeln!(stdout, "{}", out.join("model.ply").display())?;
    Ok(())
}
