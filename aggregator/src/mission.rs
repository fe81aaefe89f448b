//! A mission on one machine, from pictures to report: makes the plan, runs service and agents, and scores the result.
//!
//! Each aggregator runs on a thread ([`hierarchy`]), each agent as a process ([`agents`]). All of them send their
//! events through one channel, which one loop ([`watch`]) reads. If the mission ends early, the agents are ended too,
//! but all files stay. The same command then resumes the mission.
//!
//! What it knows nothing about: how agents train and how models are merged. It only starts the agents and the service.
//!
//! Where to start reading: [`fly`], the list of steps; then [`plan`], which decides everything before anything runs.

mod agents;
mod board;
mod city;
mod error;
mod hierarchy;
mod order;
mod phases;
mod plan;
mod progress;
mod rounds;
mod signal;
mod summary;
mod watch;

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc;

use cosurf_engine::{ViewError, Views};
use cosurf_geo::Georeference;
use cosurf_link::BrokerAddress;
use cosurf_scene::{Camera, Dataset, LocalFrame, SceneError, View, atomic, files};
use cosurf_wire::{ModelHeader, SiteId};

use crate::broker::{Broker, Reach, local_address};
use crate::evaluate::{Judge, Quality, Yardsticks};
use crate::georeference::{common_georeference, write_georeference};
use crate::merge::memory::least_bytes;
use crate::outputs::{Relief, Truth, client, deliver, relief};
use crate::report::{Drawings, EdgeSummary, MeshSummary, MissionReport, Showcase, page, showcases};
use crate::service::{Merging, global_ply, write_joined};
use crate::survey::{Accuracy, CONTOURS_M, FusedMesh, SurveyError, SurveyOrder};
use crate::terminal::Meter;
use crate::views::open_within;
use agents::{AgentCommand, AgentProcesses};
use board::{Phase, Status};
pub use city::MakeCityError;
pub use error::MissionError;
use hierarchy::{Hierarchy, edge_folder, lowest_folders};
pub use order::{MissionOrder, Surroundings};
use phases::Phases;
use plan::{Edge, Plan};
pub use plan::{PlanError, Settings};
use progress::show_pictures;
use rounds::{Round, rounds};
use signal::Signal;
use summary::summarize;
use watch::{EdgeStatus, Watch};

/// Folder of the survey in that of a mission.
pub const SURVEY: &str = "survey";

/// What a mission made.
#[derive(Clone, Debug, PartialEq)]
pub struct Flown {
    /// The figures.
    pub report: MissionReport,
    /// What the survey made, in the folder [`SURVEY`]; `None` if it failed, or if nothing tells where the model lies.
    pub accuracy: Option<Accuracy>,
}

/// Runs the mission and writes `global.ply`, `mesh.ply`, `report.json` and `report.html` to its folder, and a survey if the
/// data tell where on the earth they lie. It is no error if some agents fail, or if no mesh or survey can be made: the report
/// lists these failures.
pub fn fly(order: &MissionOrder, around: &Surroundings) -> Result<Flown, MissionError> {
    let begun = (around.now)();
    let mut phases = Phases::begin(around, order.ingest_s);
    files::create_folder(&order.out)?;
    if let Some(city) = &order.city {
        let progress = |done, of| show_pictures(around.display, done, of);
        city::make(city, &order.settings.data, progress)?;
    }
    let mut dataset = Dataset::open(&order.settings.data)?;
    let georeference = common_georeference(std::slice::from_ref(&order.settings.data))?;
    write_georeference(georeference.as_ref(), &order.out)?;
    let frame = LocalFrame::of(dataset.cameras_of_views());
    // The true surface is in memory throughout the mission, so merges, meshes and pictures may take that much less.
    let held_bytes = Yardsticks::memory_bytes(&order.settings.data);
    check_memory(&dataset, &order.settings, held_bytes)?;
    let plan = make_plan(&dataset, &order.settings, &order.out, around, "")?;
    let asked = order;
    let mut order = asked.clone();
    order.settings.merge.memory_bytes -= held_bytes;
    let order = &order;
    // Read before the agents start, so that a wrong folder is reported before the training.
    let yardsticks = Yardsticks::read(&order.settings.data, order.lpips.as_deref(), None, &frame)?;
    phases.end("preparing");
    let (earlier, last) = rounds(order);
    for (i, round) in earlier.iter().enumerate() {
        fly_round(&dataset, round, i + 1, around)?;
        phases.end(&format!("round {}", i + 1));
    }
    dataset.points = Vec::new(); // only agents need them
    let Gathered { global, board, edges } = gather(&last, around, &plan)?;
    phases.end("training and merging");
    let dataset = dataset.into_frame(&frame);
    let aligned_extent = board.iter().any(Status::has_learnt_poses).then(|| dataset.extent());
    let scene = Scene { dataset, frame, aligned_extent };
    let relief = mesh(order, around, &scene)?;
    phases.end("mesh");
    let scored = judge(order, around, &scene, &plan, &yardsticks, &relief);
    let (evaluation, scores_failure) = or_too_little_memory(scored)?;
    let evaluation = evaluation.unwrap_or_default();
    let seconds = ((around.now)() - begun).as_secs_f64();
    let mut report = summarize(&plan, &asked.settings, &board, &global, &evaluation.qualities);
    report.whole.seconds = seconds;
    (report.whole.mesh, report.whole.mesh_failure) = summary_of(relief);
    let (joined, failure) = or_too_little_memory(judge_joined(order, around, &scene, &plan))?;
    report.whole.joined = joined.flatten();
    report.whole.scores_failure = scores_failure.or(failure);
    report.whole.merging = Merging::read(&order.out);
    report.edges =
        plan.edges.iter().zip(&edges).map(|(edge, status)| summary(order, &plan, edge, status)).collect();
    phases.end("scores");
    let surveyed = georeference.map(|georeference| survey(order, around, georeference, report.whole.mesh));
    if surveyed.is_some() {
        phases.end("survey");
    }
    let (accuracy, failure) = surveyed.map_or((None, None), |surveyed| match surveyed {
        Ok(accuracy) => (Some(accuracy), None),
        Err(error) => (None, Some(error.to_string())),
    });
    report.whole.survey_failure = failure;
    report.whole.phases = phases.into_times();
    report.whole.aggregator_peak_memory_bytes = (around.peak_memory_bytes)();
    let truth = yardsticks.truth.as_ref().map(|surface| Truth { surface, frame: &scene.frame });
    let client = client(&order.out, order.settings.merge.memory_bytes, around.cores, truth);
    let (cells, views, showcases) = (&plan.cells, &plan.views, &evaluation.showcases);
    write_report(&order.out, &report, &Drawings { client: &client, cells, views, showcases })?;
    Ok(Flown { report, accuracy })
}

/// Runs agents and aggregators of a round that is not the last, in a folder of its own.
fn fly_round(
    dataset: &Dataset,
    round: &Round,
    number: usize,
    around: &Surroundings,
) -> Result<(), MissionError> {
    let MissionOrder { settings, out, .. } = &round.order;
    files::create_folder(out)?;
    let plan = make_plan(dataset, settings, out, around, &format!("-round-{number}"))?;
    gather(round, around, &plan).map(drop)
}

/// Divides the dataset among the agents. The site of a new mission is called by its session and `suffix`.
fn make_plan(
    dataset: &Dataset,
    settings: &Settings,
    out: &Path,
    around: &Surroundings,
    suffix: &str,
) -> Result<Plan, MissionError> {
    let fresh_site = SiteId::new(&format!("mission-{}{suffix}", around.session))?;
    Ok(Plan::make(dataset, settings, out, fresh_site)?)
}

/// The figures of a mesh, or why there is none. The mesh itself is gone afterwards: the survey needs its memory.
fn summary_of(relief: Relief) -> (Option<MeshSummary>, Option<String>) {
    match relief {
        Relief::Made { summary, .. } => (Some(summary), None),
        Relief::Missing(error) => (None, Some(error.to_string())),
    }
}

/// Makes the deliverables of the global model, whose mesh was made or failed.
fn survey(
    order: &MissionOrder,
    around: &Surroundings,
    georeference: Georeference,
    mesh: Option<MeshSummary>,
) -> Result<Accuracy, SurveyError> {
    let mesh = mesh.map(|mesh| FusedMesh { file: mesh_ply(&order.out), voxel_m: mesh.voxel_m });
    let survey = SurveyOrder {
        folder: order.out.clone(),
        out: order.out.join(SURVEY),
        georeference,
        mesh,
        geoid: order.geoid.clone(),
        gsd_m: None,
        contours_m: CONTOURS_M,
        volumes: None,
        memory_bytes: order.settings.merge.memory_bytes,
        threads: around.cores,
    };
    deliver(&survey, around.display, || (around.now)())
}

/// Fails before the training if no merge of the agents' models will be possible within the memory for merges, of which
/// `held_bytes` are taken.
fn check_memory(dataset: &Dataset, settings: &Settings, held_bytes: u64) -> Result<(), MissionError> {
    let shrunk = |view: &View| {
        let long_side_px = view.camera.size_px[0].max(view.camera.size_px[1]);
        view.camera.fitted(long_side_px.min(settings.max_size_px.unwrap_or(u32::MAX)))
    };
    let needed_bytes = held_bytes + least_bytes(dataset.views.iter().map(shrunk));
    match settings.merge.memory_bytes < needed_bytes {
        true => Err(MissionError::LittleMergeMemory { needed_bytes }),
        false => Ok(()),
    }
}

/// The results of agents and aggregators.
struct Gathered {
    /// Header of the newest global model.
    global: ModelHeader,
    /// The status of each agent.
    board: Vec<Status>,
    /// The status of each edge aggregator.
    edges: Vec<EdgeStatus>,
}

/// Runs agents and aggregators until the agents' models are merged.
fn gather(round: &Round, around: &Surroundings, plan: &Plan) -> Result<Gathered, MissionError> {
    let order = &round.order;
    if !around.agent.is_file() {
        return Err(MissionError::NoAgent { path: around.agent.clone() });
    }
    let (broker, address, house) = reach_broker(order)?;
    let (say, signals) = mpsc::channel();
    let mut hierarchy = Hierarchy::start(order, around, plan, &house, &say)?;
    let mut watch = Watch::new(plan, around, signals);
    watch.await_broker(&hierarchy)?;
    let processes = AgentProcesses::start(agent_commands(round, around, plan, &address)?, move |event| {
        let _ = say.send(Signal::Agent(event)); // fails only after the end of the mission
    });
    watch.await_agents(&hierarchy)?;
    drop(processes);
    watch.await_edges(&mut hierarchy)?;
    let (board, edges) = watch.into_boards();
    let global = hierarchy.finish();
    if let Some(broker) = broker {
        broker.shutdown();
    }
    Ok(Gathered { global: global.ok_or_else(|| first_failure(plan, &board))?, board, edges })
}

/// The figures of an edge aggregator.
fn summary(order: &MissionOrder, plan: &Plan, edge: &Edge, status: &EdgeStatus) -> EdgeSummary {
    EdgeSummary {
        device: edge.device.to_string(),
        agents: plan.devices[edge.agents.clone()].iter().map(ToString::to_string).collect(),
        bytes_sent: status.bytes_sent,
        merging: Merging::read(&edge_folder(&order.out, edge)),
    }
}

/// The mission's own broker if it uses no other, where the agents connect, and how the aggregators do.
fn reach_broker(order: &MissionOrder) -> Result<(Option<Broker>, BrokerAddress, Reach), MissionError> {
    if let Some(address) = &order.broker {
        return Ok((None, address.clone(), Reach::plain(address.clone())));
    }
    let broker = Broker::start(([127, 0, 0, 1], 0).into())?;
    let (address, house) = (local_address(broker.address()), broker.house());
    Ok((Some(broker), address, house))
}

/// Writes the configuration of each agent and returns the commands that start the agents. Agents share the cores
/// evenly.
fn agent_commands(
    Round { order, before }: &Round,
    around: &Surroundings,
    plan: &Plan,
    address: &BrokerAddress,
) -> Result<Vec<AgentCommand>, MissionError> {
    let threads = (around.cores / plan.devices.len()).max(1);
    let command = |agent| {
        let folder =
            plan.write_agent_config(agent, &order.settings, &order.out, before.as_deref(), address, threads)?;
        let config = folder.join("agent.toml").display().to_string();
        Ok(AgentCommand {
            program: around.agent.clone(),
            arguments: ["run", "--config", &config, "--json"].map(String::from).to_vec(),
            log: folder.join("agent.log"),
        })
    };
    (0..plan.devices.len()).map(command).collect()
}

fn first_failure(plan: &Plan, board: &[Status]) -> MissionError {
    let failures = plan.devices.iter().zip(board).filter_map(|(device, status)| match &status.phase {
        Phase::Failed { reason } => Some((*device, reason.clone())),
        _ => None,
    });
    let first = failures.into_iter().next();
    first
        .map_or(MissionError::ServiceDied, |(device, reason)| MissionError::NothingArrived { device, reason })
}

/// The pictures of the mission, and the frame that their cameras are in.
struct Scene {
    dataset: Dataset,
    frame: LocalFrame,
    /// Extent of the scene, world units, if agents have learnt poses: then views are aligned before they are scored.
    aligned_extent: Option<f64>,
}

impl Scene {
    fn held_out(&self, plan: &Plan) -> Vec<&View> {
        let views = self.dataset.views.iter().zip(&plan.views);
        views.filter(|(_, planned)| planned.held_out).map(|(view, _)| view).collect()
    }

    /// The model in a PLY file, to be rendered within the memory of the mission's merges.
    fn model(&self, file: PathBuf, order: &MissionOrder, around: &Surroundings) -> Result<Views, SceneError> {
        open_within(file, &self.frame, order.settings.merge.memory_bytes, around.cores)
    }
}

/// A result, or the reason if there is too little memory for it: a mission goes on without scores.
fn or_too_little_memory<T>(
    result: Result<T, MissionError>,
) -> Result<(Option<T>, Option<String>), MissionError> {
    match result {
        Ok(value) => Ok((Some(value), None)),
        Err(MissionError::View(error @ ViewError::TooLittleMemory { .. })) => {
            Ok((None, Some(format!("{error}; allow more memory (--merge-memory)"))))
        }
        Err(error) => Err(error),
    }
}

/// The mesh in the folder of a mission.
fn mesh_ply(folder: &Path) -> PathBuf {
    folder.join("mesh.ply")
}

/// Makes the mesh of the global model.
fn mesh(order: &MissionOrder, around: &Surroundings, scene: &Scene) -> Result<Relief, MissionError> {
    // Those that the agents trained on, as with `cosurf-aggregator run` and `mesh`.
    let cameras = Dataset::cameras(&order.out)?;
    let cameras: Vec<Camera> = cameras.iter().map(|camera| scene.frame.local_camera(camera)).collect();
    let mut meter = Meter::new(around.display);
    let file = mesh_ply(&order.out);
    let memory_bytes = order.settings.merge.memory_bytes;
    let model = global_ply(&order.out);
    let relief = relief(&model, &cameras, &scene.frame, memory_bytes, around.cores, &file, |event| {
        meter.show_fusion(event, (around.now)().as_secs_f64());
        ControlFlow::Continue(())
    })?;
    meter.finish();
    Ok(relief)
}

/// The scores of the global model.
#[derive(Default)]
struct Evaluation {
    /// One entry for each held-out view, in the order of the views.
    qualities: Vec<Quality>,
    /// A few of the held-out views with their pictures, the best first.
    showcases: Vec<Showcase>,
}

/// Scores the global model against the held-out photographs and, if the true surface is known, against that.
fn judge(
    order: &MissionOrder,
    around: &Surroundings,
    scene: &Scene,
    plan: &Plan,
    yardsticks: &Yardsticks,
    relief: &Relief,
) -> Result<Evaluation, MissionError> {
    let views = scene.held_out(plan);
    let model = scene.model(global_ply(&order.out), order, around)?;
    let mut judge = Judge::new(model, order.settings.max_size_px, yardsticks).aligning(scene.aligned_extent);
    let mesh = match relief {
        Relief::Made { caster, .. } => Some(caster),
        Relief::Missing(_) => None,
    };
    let qualities = judge.qualities(&views)?;
    let showcases = showcases(&mut judge, &views, &qualities, mesh, scene.frame.unit())?;
    Ok(Evaluation { qualities, showcases })
}

/// Scores the agents' models as they were sent, joined but not merged, for comparison with the global model. Returns
/// the mean PSNR and SSIM over the held-out views; `None` if no view is held out.
fn judge_joined(
    order: &MissionOrder,
    around: &Surroundings,
    scene: &Scene,
    plan: &Plan,
) -> Result<Option<Quality>, MissionError> {
    let scratch = tempfile::tempdir_in(&order.out).map_err(|cause| SceneError::io(&order.out, cause))?;
    let file = scratch.path().join("joined.ply");
    write_joined(&lowest_folders(&order.out, plan), &file, &scene.frame)?;
    let without = Yardsticks { lpips: None, truth: None };
    let model = scene.model(file, order, around)?;
    let mut judge = Judge::new(model, order.settings.max_size_px, &without).aligning(scene.aligned_extent);
    Ok(Quality::mean(&judge.qualities(&scene.held_out(plan))?))
}

fn write_report(out: &Path, report: &MissionReport, drawings: &Drawings) -> Result<(), MissionError> {
    atomic::write_bytes(&out.join("report.json"), &serde_json::to_vec_pretty(report)?)?;
    atomic::write_bytes(&out.join("report.html"), page(report, drawings).as_bytes())?;
    Ok(())
}
