//! `run`: a whole flight's work after landing: train, publish, receive.

use std::fs;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use clap::Args;
use cosurf_agent::changes::compare;
use cosurf_agent::outputs::write_json;
use cosurf_agent::publish::{Publication, Sharing, global_ply, publish, tell};
use cosurf_agent::session::{self, SH_DEGREE, Split, TrainPlan};
use cosurf_agent::warm;
use cosurf_contract::{AgentConfig, AgentEvent, AgentLink, ComparedWith, Share};
use cosurf_engine::{PruneSettings, Renderer, SurfaceSettings, base_of};
use cosurf_link::serial::DEVICE_MESSAGE_BYTES;
use cosurf_link::{
    BrokerAddress, Credentials, Identity, MqttConfig, MqttTransport, Outgoing, PublishError, Role,
    SerialConfig, SerialTransport, Tls, Transport, TransportEvent, next_session,
};
use cosurf_scene::{Camera, ply};

use super::progress::Progress;
use super::{beginning, cores, default_memory, train};

/// How long a broker is waited for before the training, which needs none.
const PATIENCE: Duration = Duration::from_secs(5);

/// Train by the orders of a configuration file, publish the model to the aggregator, receive the global model,
/// keep both. Started again after a stop or a kill, it goes on where it was.
#[derive(Args, Debug)]
pub(super) struct RunArgs {
    /// The agent's orders
    #[arg(long, value_name = "FILE", default_value = "agent.toml")]
    config: PathBuf,
    /// Print one JSON event a line instead of text for people
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &RunArgs) -> Result<()> {
    let text = fs::read_to_string(&args.config).with_context(|| args.config.display().to_string())?;
    let config = AgentConfig::from_toml(&text).with_context(|| args.config.display().to_string())?;
    let credentials = Credentials::load(
        config.frame.unwrap_or_default(),
        config.key.as_deref(),
        config.trusted.as_deref(),
    )?;
    let route = Route::of(&config)?;
    let plan = plan(&config);
    let mut progress = Progress::new(args.json);
    let line = |route: &Route| -> Result<(Identity, Line)> {
        let clock_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let session = next_session(&config.out.join("session"), clock_s)?;
        let identity = Identity { site: config.site, device: config.device, session, role: Role::Device };
        Ok((identity, route.open(identity)))
    };
    let started = Instant::now();
    let now = || started.elapsed() + Duration::from_secs(1);
    let flight = config.compress.then(|| session::flight(&plan)).transpose()?;
    if let Some(flight) = &flight {
        fs::create_dir_all(&config.out).with_context(|| config.out.display().to_string())?;
        let (identity, mut line) = line(&route)?;
        tell(identity, &credentials, flight, &mut line, now, PATIENCE, route.farewell());
    }
    train::train(&plan, &config.out, false, &mut progress)?;

    let splats = ply::read(&config.out.join("model.ply"))?;
    let cameras = config.out.join("cameras.json");
    let cameras: Vec<Camera> =
        serde_json::from_slice(&fs::read(&cameras).with_context(|| cameras.display().to_string())?)?;
    let kept_bytes = (plan.memory_bytes / 4) as usize;
    let base =
        base_of(&splats, &cameras, plan.threads, kept_bytes, |step, steps| progress.preparing(step, steps));
    let compared = Compared { plan: &plan, cameras: &cameras, out: &config.out };
    if let Some(init) = &plan.init {
        let mut renderer = Renderer::new(&splats, plan.threads);
        compared.show(ComparedWith::Init, init, &mut renderer, &mut progress)?;
    }
    let sharing =
        flight.as_ref().map(|flight| Sharing { flight, quiet: route.quiet(), threads: plan.threads });
    let (identity, mut line) = line(&route)?;
    let publication = Publication {
        identity,
        splats: &splats,
        cameras: &cameras,
        base: base.as_ref(),
        sharing,
        credentials: &credentials,
        out: &config.out,
        wait_global: config.wait_global,
        inbox_bytes: plan.memory_bytes / 2,
        farewell: route.farewell(),
    };
    publish(&publication, &mut line, now, |event| progress.show(&event))?;
    drop(line);
    if config.wait_global {
        let mut renderer = Renderer::new(&splats, plan.threads);
        compared.show(ComparedWith::Global, &global_ply(&config.out), &mut renderer, &mut progress)?;
    }
    Ok(())
}

/// The agent's own model beside others.
struct Compared<'a> {
    plan: &'a TrainPlan,
    cameras: &'a [Camera],
    out: &'a Path,
}

impl Compared<'_> {
    /// Tells, and keeps in a file, how `other`, a PLY, differs from the agent's `own` model on the ground of its cameras. One that is too
    /// large for the memory is passed over.
    fn show(
        &self,
        with: ComparedWith,
        other: &Path,
        own: &mut Renderer,
        progress: &mut Progress,
    ) -> Result<()> {
        let file_bytes = fs::metadata(other).with_context(|| other.display().to_string())?.len();
        if file_bytes > self.plan.memory_bytes / 4 {
            return Ok(());
        }
        let splats = warm::beginning(other, self.cameras, usize::MAX, SH_DEGREE)?;
        let mut other = Renderer::new(&splats, self.plan.threads);
        let (before, after) = match with {
            ComparedWith::Init => (&mut other, own),
            ComparedWith::Global => (own, &mut other),
        };
        if let Some(changes) = compare(before, after, self.cameras) {
            let file = match with {
                ComparedWith::Init => "changes-init.json",
                ComparedWith::Global => "changes-global.json",
            };
            write_json(&self.out.join(file), &changes)?;
            progress.show(&AgentEvent::Compared { with, changes });
        }
        Ok(())
    }
}

/// How the aggregator is reached.
enum Route {
    Broker { broker: BrokerAddress, tls: Option<Tls> },
    Serial { port: String, baud: NonZeroU32 },
}

impl Route {
    fn of(config: &AgentConfig) -> Result<Self> {
        Ok(match config.link()? {
            AgentLink::Broker { address, tls } => {
                Self::Broker { broker: address.clone(), tls: Tls::for_broker(address, tls)? }
            }
            AgentLink::Serial { port, baud } => Self::Serial { port: port.to_owned(), baud },
        })
    }

    /// Opens the line.
    fn open(&self, identity: Identity) -> Line {
        match self {
            Self::Broker { broker, tls } => {
                let (broker, tls) = (broker.clone(), tls.clone());
                Line::Broker(MqttTransport::start(MqttConfig { broker, identity, tls }))
            }
            Self::Serial { port, baud } => {
                let config = SerialConfig::device(port, *baud, identity.session, DEVICE_MESSAGE_BYTES);
                Line::Serial(SerialTransport::start(config))
            }
        }
    }

    /// What a broker has kept has come when nothing has for this long.
    fn quiet(&self) -> Duration {
        match self {
            Self::Broker { .. } => Duration::from_secs(2),
            Self::Serial { .. } => Duration::from_secs(20),
        }
    }

    /// After the last acknowledgement the link gets this long to carry it out.
    fn farewell(&self) -> Duration {
        match self {
            Self::Broker { .. } => Duration::from_secs(1),
            Self::Serial { .. } => Duration::from_secs(10),
        }
    }
}

/// An open line.
enum Line {
    Broker(MqttTransport),
    Serial(SerialTransport),
}

impl Transport for Line {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        match self {
            Self::Broker(line) => line.publish(message),
            Self::Serial(line) => line.publish(message),
        }
    }

    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent> {
        match self {
            Self::Broker(line) => line.poll(timeout),
            Self::Serial(line) => line.poll(timeout),
        }
    }
}

fn plan(config: &AgentConfig) -> TrainPlan {
    let split = if config.views.is_empty() && config.held_out.is_empty() {
        Split::Every(config.eval_every)
    } else {
        Split::Named { train: config.views.clone(), held_out: config.held_out.clone() }
    };
    let ratio = config.prune.map_or(PruneSettings::default().ratio, Share::get);
    TrainPlan {
        data: config.data.clone(),
        split,
        steps: config.steps.max(1),
        seed: config.seed,
        memory_bytes: config.memory_bytes.unwrap_or_else(default_memory),
        max_size_px: config.max_size_px.unwrap_or(u32::MAX),
        device: config.compute.unwrap_or_default(),
        threads: config.threads.unwrap_or_else(cores).clamp(1, 1024),
        surface: (!config.color_only).then(SurfaceSettings::default),
        prune: (ratio > 0.0).then(|| PruneSettings { ratio, ..PruneSettings::default() }),
        exposure: config.exposure,
        // On the first flight no global model has come yet.
        init: beginning(config.init.as_ref(), &config.out)
            .filter(|init| init.is_file() || config.init.as_ref() == Some(init)),
        one_of_many: !config.alone,
    }
}
