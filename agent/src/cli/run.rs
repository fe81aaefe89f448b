//! `run`: trains on the pictures of a flight, publishes the model and receives the global model.

mod choice;
mod comparison;
mod doctor;
mod reporter;
mod route;
mod watch;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail};
use clap::Args;
use cosurf_agent::arrival::Arrival;
use cosurf_agent::publish::{Publication, Sharing, global_models, global_ply, publish};
use cosurf_agent::session::{self, Split, TrainPlan};
use cosurf_agent::status::StatusBoard;
use cosurf_agent::{checkpoint, ingest, outputs};
use cosurf_contract::{AgentConfig, AgentEvent, ComparedWith, Share, usage};
use cosurf_engine::{PruneSettings, SurfaceSettings, base_of};
use cosurf_geo::Geodetic;
use cosurf_link::{Credentials, Identity, Role, SecretKey, next_session};
use cosurf_scene::{Camera, FolderLock, LocalFrame, Splats, atomic, camera_list, ply};
use cosurf_wire::DeviceId;

use super::host::{self, cores, default_memory};
use super::paths::resolve_init;
use super::progress::Progress;
use super::train::Start;
use super::{stop, train};
use choice::Answer;
use comparison::Comparison;
pub(super) use doctor::{DoctorArgs, doctor};
use reporter::{CONNECT_TIMEOUT, Reporter};
use route::{Connection, Route};
use watch::{FailedFlight, Watched};

/// Train with the settings in a configuration file, publish the model to the aggregator, and receive the global model.
/// To resume after a stop or a kill, run the same command again.
#[derive(Args, Debug)]
pub(super) struct RunArgs {
    #[command(flatten)]
    job: JobArgs,
    /// Start again even if the output folder has a checkpoint. With --watch, the agent does so by itself where it cannot go on
    #[arg(long, conflicts_with = "watch")]
    fresh: bool,
    /// Wait for pictures in this folder, in place of `data`, and train once nothing in it has changed for ten seconds; then
    /// wait for those of the next flight. It may hold a dataset, or photographs, which COLMAP then poses
    #[arg(long, value_name = "FOLDER")]
    watch: Option<PathBuf>,
    /// With --watch, origin of the site for photographs, latitude and longitude in degrees and height in metres. Give the
    /// same to all drones of a site
    #[arg(long, value_name = "LAT,LON,HEIGHT", allow_hyphen_values = true, requires = "watch")]
    origin: Option<Geodetic>,
}

/// What `run` and `preflight` work on.
#[derive(Args, Debug)]
struct JobArgs {
    /// The configuration file
    #[arg(long, value_name = "FILE", default_value = "agent.toml")]
    config: PathBuf,
    /// Print events as JSON, one per line, instead of text
    #[arg(long)]
    json: bool,
}

/// Check before a flight all that `run` needs, without training: the configuration, the pictures, memory and disk, the
/// device to train on, and that the aggregator answers. Fails if anything is wrong.
#[derive(Args, Debug)]
pub(super) struct PreflightArgs {
    #[command(flatten)]
    job: JobArgs,
}

pub(super) fn preflight(PreflightArgs { job: args }: &PreflightArgs) -> Result<()> {
    let mut job = Job::load(&args.config)?;
    let _lock = FolderLock::take(&job.config.out, "cosurf-agent preflight")?;
    job.make_folders()?;
    let board = StatusBoard::new(job.config.steps);
    let mut progress = Progress::new(args.json);
    let (answer, unreached) = job.try_line(&board, &mut progress)?;
    job.follow_plan(choice::begun_with(&job.config.out), answer, &mut progress)?;
    let report = train::prepare(&job.plan, &job.config.out)?;
    if let Some(why) = unreached {
        bail!(why);
    }
    session::check_pictures_are_whole(&job.plan)?;
    progress.show(&AgentEvent::Ready { report });
    Ok(())
}

pub(super) fn run(RunArgs { job: args, fresh, watch, origin }: &RunArgs) -> Result<()> {
    let mut job = Job::load(&args.config)?;
    let _lock = FolderLock::take(&job.config.out, "cosurf-agent run")?;
    job.make_folders()?;
    let board = StatusBoard::new(job.config.steps);
    if let Some(board) = job.board(&board) {
        stop::tell_on(board);
    }
    let mut progress = Progress::new(args.json).with_board(&board);
    let Some(folder) = watch else { return job.fly(Start::attended(*fresh), &board, &mut progress) };
    job.fly_all(&Watched::open(folder, &job.config.out)?, *origin, &board, &mut progress)
}

/// A configuration that has been checked, with the plan for the training and the content of the key files.
struct Job {
    config: AgentConfig,
    device: DeviceId,
    plan: TrainPlan,
    credentials: Credentials,
    route: Route,
    started: Instant,
}

/// The model that the training wrote, with the cameras that it was trained on.
struct LocalModel {
    /// The frame of both.
    frame: LocalFrame,
    splats: Splats,
    cameras: Vec<Camera>,
}

impl LocalModel {
    fn read(out: &Path) -> Result<Self> {
        let cameras = camera_list::read(&out.join(camera_list::FILE))?;
        let frame = LocalFrame::of(cameras.iter());
        let splats = ply::read(&out.join("model.ply"), &frame)?;
        let cameras = cameras.iter().map(|camera| frame.local_camera(camera)).collect();
        Ok(Self { frame, splats, cameras })
    }
}

impl Job {
    /// Makes the folders in `out` before the training, so that an obstacle, or a missing right to write, is reported early.
    fn make_folders(&self) -> Result<()> {
        let out = &self.config.out;
        checkpoint::make_folder(out)?;
        Ok(atomic::prepare_folder(&global_models(out))?)
    }

    fn load(path: &Path) -> Result<Self> {
        let text = fs::read_to_string(path).with_context(|| {
            format!("{}: cannot be read; name another file with --config", path.display())
        })?;
        let config = AgentConfig::from_toml(&text).with_context(|| path.display().to_string())?;
        let frame = config.frame.unwrap_or_default();
        let AgentConfig { key, trusted, fleet, .. } = &config;
        let named = || path.display().to_string();
        let credentials = Credentials::load(frame, key.as_deref(), trusted.as_deref(), fleet.as_deref())
            .with_context(named)?;
        let device = config.device.map_or_else(host::device, Ok).with_context(named)?;
        let route = Route::of(&config, device).with_context(named)?;
        Ok(Self { plan: train_plan(&config), device, credentials, route, started: Instant::now(), config })
    }

    /// Trains on the pictures of one flight, sends the model, and compares it with the global one.
    fn fly(&mut self, start: Start, board: &StatusBoard, progress: &mut Progress) -> Result<()> {
        let begun_with = if start == Start::Fresh { None } else { choice::begun_with(&self.config.out) };
        if begun_with.is_none() && self.config.init.is_some() && self.plan.init.is_none() {
            eprintln!(
                "{}: there is no global model yet (`init`); the training starts from the points",
                global_ply(&self.config.out).display()
            );
        }
        let reporter = self.connect(begun_with, board, progress)?;
        // While the connection is there, everybody is told why the agent ends.
        let flight = board.follow_result(self.flight())?;
        let reporter = self.announce(flight.as_deref(), reporter);
        board.follow_result(train::train(&self.plan, &self.config.out, start, progress))?;
        let model = LocalModel::read(&self.config.out)?;
        self.publish(&model, flight.as_deref(), (board, reporter), progress)?;
        if self.config.wait_global {
            let global = global_ply(&self.config.out);
            self.compare(&model, ComparedWith::Global, &global, progress)?;
        }
        // Everything is delivered, so a report that cannot be written is no failure.
        if let Err(error) = outputs::note_peak(&self.config.out, usage::peak_bytes()) {
            tracing::warn!("the report still has the peak memory of the training alone: {error:#}");
        }
        Ok(())
    }

    /// Trains on one flight after the other, as they arrive in a folder, until it is asked to end. A flight that fails is
    /// told; the next one begins once the folder has changed.
    fn fly_all(
        &mut self,
        watched: &Watched,
        origin: Option<Geodetic>,
        board: &StatusBoard,
        progress: &mut Progress,
    ) -> Result<()> {
        let mut failed = None;
        loop {
            let (arrival, data) = self.await_pictures(watched, failed.as_ref(), origin, board, progress)?;
            let flown = data.and_then(|data| {
                self.plan = TrainPlan { data, ..train_plan(&self.config) };
                self.fly(Start::Unattended, board, progress)
            });
            failed = match flown {
                Ok(()) => {
                    watched.finish(arrival)?;
                    None
                }
                Err(error) if stop::is_asked() => return Err(error),
                Err(error) => Some(FailedFlight { flight: arrival.flight, reason: format!("{error:#}") }),
            };
        }
    }

    /// Waits for the pictures of the next flight, which is another one than `failed`, and returns it with the folder of its
    /// dataset, or why there is none. Tells meanwhile that the agent waits, except on a radio.
    fn await_pictures(
        &self,
        watched: &Watched,
        failed: Option<&FailedFlight>,
        origin: Option<Geodetic>,
        board: &StatusBoard,
        progress: &mut Progress,
    ) -> Result<(Arrival, Result<PathBuf>)> {
        let problem = failed.map(|failed| failed.reason.clone());
        progress.show(&AgentEvent::Watching { folder: watched.folder().to_owned(), problem });
        let identity = self.identity()?;
        let _reporter = (!self.route.is_radio()).then(|| {
            let connection = self.route.connect_reporting(identity, self.credentials.key.as_ref());
            Reporter::start(identity, self.credentials.clone(), connection, Some(board), false, progress).0
        });
        let arrival = watched.wait(failed)?;
        let data = watched.begin(&arrival, origin, self.config.max_size_px, progress);
        Ok((arrival, data))
    }

    /// Monotonic time since an arbitrary moment in the past.
    fn now(&self) -> Duration {
        self.started.elapsed() + Duration::from_secs(1)
    }

    /// The identity of the device in a new session.
    fn identity(&self) -> Result<Identity> {
        let AgentConfig { site, out, .. } = &self.config;
        let clock_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let session = next_session(&out.join("session"), clock_s)?;
        Ok(Identity { site: *site, device: self.device, session, role: Role::Device })
    }

    /// The cameras of all pictures that this device trains on, which it announces to the other devices; `None` if `compress`
    /// is not set.
    fn flight(&self) -> Result<Option<Vec<Camera>>> {
        self.config.compress.then(|| session::flight(&self.plan)).transpose()
    }

    /// Connects, and asks the aggregator for this device's cell of the plan. Chooses the pictures by the answer, and
    /// tells how far the agent is while it trains. A training that was begun keeps its pictures.
    fn connect(
        &mut self,
        begun_with: Option<Option<Answer>>,
        board: &StatusBoard,
        progress: &mut Progress,
    ) -> Result<Reporter> {
        let asks = begun_with.is_none();
        let (reporter, answer) = self.ask(Route::connect_reporting, asks, board, progress)?;
        let doubt = match (reporter.is_connected(), reporter.has_problem()) {
            (true, _) => (asks && answer.is_none()).then(|| self.unanswered()),
            (false, true) => Some("no connection; the training begins without one".to_owned()),
            (false, false) => {
                Some(format!("{}; the training begins without it", self.route.unheard(CONNECT_TIMEOUT)))
            }
        };
        if let Some(reason) = doubt {
            progress.show(&AgentEvent::Retrying { reason, attempt: 1 });
        }
        board.follow_result(self.follow_plan(begun_with, answer, progress))?;
        Ok(reporter)
    }

    /// Tries the way to the aggregator before a flight. Returns its answer, if one came, and otherwise what is wrong; all
    /// that the connection tells is shown.
    fn try_line(
        &self,
        board: &StatusBoard,
        progress: &mut Progress,
    ) -> Result<(Option<Answer>, Option<String>)> {
        match self.route.is_name_taken(self.identity()?) {
            Ok(false) => {}
            Ok(true) => return Ok((None, Some(self.name_taken()))),
            Err(reason) => return Ok((None, Some(reason))),
        }
        let (reporter, answer) = self.ask(Route::connect_asking, true, board, progress)?;
        let unreached = match (reporter.has_problem(), reporter.is_connected(), &answer) {
            (true, ..) => {
                Some("the aggregator cannot be reached as configured; the lines above tell why".to_owned())
            }
            (_, false, _) => Some(self.route.unheard(CONNECT_TIMEOUT)),
            (_, true, None) => Some(self.unanswered()),
            (_, true, Some(_)) => None,
        };
        Ok((answer, unreached))
    }

    /// What is wrong if the broker counts this device as connected.
    fn name_taken(&self) -> String {
        let Self { device, config: AgentConfig { site, .. }, .. } = self;
        format!(
            "another program is connected to the broker as {device} of the site {site}: stop it, or give this one another \
             `device`; if it has crashed, the broker notices within a minute"
        )
    }

    /// Connects by `connect`. If the agent `asks` for its cell, also returns the answer, unless none arrived in time.
    fn ask(
        &self,
        connect: fn(&Route, Identity, Option<&SecretKey>) -> Connection,
        asks: bool,
        board: &StatusBoard,
        progress: &mut Progress,
    ) -> Result<(Reporter, Option<Answer>)> {
        let identity = self.identity()?;
        let connection = connect(&self.route, identity, self.credentials.key.as_ref());
        let (credentials, board) = (self.credentials.clone(), self.board(board));
        Ok(Reporter::start(identity, credentials, connection, board, asks, progress))
    }

    /// Why no answer may have come over a connection.
    fn unanswered(&self) -> String {
        let Self { config: AgentConfig { site, .. }, device, .. } = self;
        format!(
            "no aggregator of the site {site} answers {device}: check `site`, that the aggregator runs at this broker, and \
             that its list of trusted keys has this device's `key`"
        )
    }

    /// Chooses pictures and frame by what an earlier run has begun with, or else by the answer of the aggregator.
    fn follow_plan(
        &mut self,
        begun_with: Option<Option<Answer>>,
        answer: Option<Answer>,
        progress: &mut Progress,
    ) -> Result<()> {
        let resumed = begun_with.is_some();
        let answer = begun_with.unwrap_or(answer);
        self.credentials.frame = choice::frame(&self.config, answer.as_ref())?;
        progress.show(&choice::choose(&mut self.plan, answer.as_ref(), resumed)?);
        choice::keep(&self.config.out, answer.as_ref())
    }

    /// Announces the flight. On a radio, the connection ends after the announcement: it would take the line from other
    /// devices.
    fn announce(&self, flight: Option<&[Camera]>, reporter: Reporter) -> Option<Reporter> {
        if let Some(flight) = flight {
            reporter.announce(self.credentials.clone(), flight.to_vec());
        }
        if !self.route.is_radio() {
            return Some(reporter);
        }
        if flight.is_some() && reporter.is_connected() {
            std::thread::sleep(self.route.flush_time());
        }
        None
    }

    /// The board, unless the line is too slow for statuses.
    fn board<'a>(&self, board: &'a StatusBoard) -> Option<&'a StatusBoard> {
        (!self.route.is_radio()).then_some(board)
    }

    /// Trains the base (the small model that is sent first), sends the model and, if `wait_global` is set, waits for
    /// the global model. If training started from a model, shows before the upload how the new model differs from that
    /// one. `reporter` tells how far the agent is until the upload has its own connection, which is closed on return.
    fn publish(
        &self,
        model: &LocalModel,
        flight: Option<&[Camera]>,
        (board, reporter): (&StatusBoard, Option<Reporter>),
        progress: &mut Progress,
    ) -> Result<()> {
        let LocalModel { frame, splats, cameras } = model;
        let (threads, cache_bytes) = (self.plan.threads, (self.plan.memory_bytes / 4) as usize);
        let base =
            base_of(splats, cameras, threads, cache_bytes, |step, steps| progress.preparing(step, steps));
        if let Some(init) = &self.plan.init {
            self.compare(model, ComparedWith::Init, init, progress)?;
        }
        let (quiet, flights_max) = (self.route.quiet_time(), self.config.flights_max);
        let sharing = flight.map(|flight| Sharing { flight, quiet, flights_max });
        drop(reporter);
        let identity = self.identity()?;
        let mut connection = self.route.connect(identity, self.credentials.key.as_ref());
        let publication = Publication {
            identity,
            frame,
            is_placed: !ingest::is_without_place(&self.plan.data),
            splats,
            cameras,
            base: base.as_ref(),
            sharing,
            credentials: &self.credentials,
            out: &self.config.out,
            wait_global: self.config.wait_global,
            inbox_bytes: self.plan.memory_bytes / 2,
            flush_time: self.route.flush_time(),
            status: self.board(board),
        };
        publish(&publication, &mut connection, || self.now(), |event| progress.show(&event))
    }

    /// Shows how the agent's own model differs from the model in the PLY file `other`.
    fn compare(
        &self,
        model: &LocalModel,
        with: ComparedWith,
        other: &Path,
        progress: &mut Progress,
    ) -> Result<()> {
        let comparison = Comparison {
            frame: &model.frame,
            splats: &model.splats,
            cameras: &model.cameras,
            memory_bytes: self.plan.memory_bytes,
            threads: self.plan.threads,
            out: &self.config.out,
        };
        comparison.show(with, other, progress)
    }
}

fn train_plan(config: &AgentConfig) -> TrainPlan {
    let split = if config.views.is_empty() && config.held_out.is_empty() {
        Split::Every(config.eval_every)
    } else {
        Split::Named { train: config.views.clone(), held_out: config.held_out.clone() }
    };
    let ratio = config.prune.map_or(PruneSettings::default().ratio, Share::get);
    TrainPlan {
        data: config.data.clone(),
        split,
        steps: config.steps,
        seed: config.seed,
        memory_bytes: config.memory_bytes.unwrap_or_else(default_memory),
        max_size_px: config.max_size_px.unwrap_or(u32::MAX),
        device: config.compute.unwrap_or_default(),
        threads: config.threads.unwrap_or_else(cores),
        surface: (!config.color_only).then(SurfaceSettings::default),
        prune: (ratio > 0.0).then(|| PruneSettings { ratio, ..PruneSettings::default() }),
        exposure: config.exposure,
        poses: config.poses,
        // The word `global` names a file that is missing until the first global model has arrived. While it is missing,
        // training starts from the sparse cloud. Any other missing file stays in the plan, so that it is reported as an
        // error.
        init: resolve_init(config.init.as_ref(), &config.out)
            .filter(|init| init.is_file() || config.init.as_ref() == Some(init)),
        one_of_many: !config.alone,
    }
}
