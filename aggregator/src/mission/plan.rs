//! The plan of a mission, made before anything runs: the views and the configuration of each agent.
//!
//! `mission.json` stores the settings. The same command in the same folder resumes the mission; a command with other
//! settings is refused as soon as an agent has learnt anything.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use cosurf_contract::{AgentConfig, CHECKPOINT, DEFAULT_FLIGHTS_MAX};
use cosurf_engine::PoseChoice;
use cosurf_link::BrokerAddress;
use cosurf_scene::{Dataset, Ground, SceneError, atomic, files, footprints};
use cosurf_wire::{DeviceId, IdError, SiteId};
use serde::{Deserialize, Serialize};

use crate::merge::MergeSettings;
use crate::partition::{AssignedView, Cell, Division, PartitionError, invite, nearest_cell, partition};

/// The settings that decide the result of a mission.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// The dataset's folder.
    pub data: PathBuf,
    /// Number of edge aggregators below the root aggregator; 0 for none.
    pub edges: usize,
    /// How the ground is divided among the agents of each edge or, without edges, of the root.
    pub division: Division,
    /// Width of the margin around each cell, as a share of the cell's size. The cell's agent also gets the views of
    /// other cells that look at this margin; see `partition`.
    pub margin: f64,
    /// Training steps of each agent, in all rounds together.
    pub steps: u32,
    /// Number of rounds, at least 1. In each, all agents train and their models are merged; in all but the first, they begin
    /// from the global model of the round before.
    #[serde(default = "one_round")]
    pub rounds: u32,
    /// Memory limit of each agent, bytes; `None` to let the agent choose.
    pub memory_bytes: Option<u64>,
    /// Limit on the long side of the training pictures, px; `None` for their full size.
    pub max_size_px: Option<u32>,
    /// Whether the agents learn the poses of their pictures.
    #[serde(default)]
    pub poses: PoseChoice,
    /// Seed of every random choice.
    pub seed: u64,
    /// Every n-th view by name is held out; 0 holds out none.
    pub eval_every: u32,
    /// Whether each agent drops, before the upload, the splats on ground that another agent observed better.
    #[serde(default)]
    pub compress_first: bool,
    /// How the agents' models are merged.
    pub merge: MergeSettings,
}

/// The folder of all agents' folders.
const AGENTS: &str = "agents";

fn one_round() -> u32 {
    1
}

/// The content of `mission.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Record {
    /// The site is chosen once. So a resumed mission finds its own messages at the broker, and no others.
    site: SiteId,
    settings: Settings,
}

/// Why a mission cannot be planned.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A file could not be read or written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The views cannot be divided.
    #[error(transparent)]
    Partition(#[from] PartitionError),
    /// The folder has a mission with other settings.
    #[error(
        "{out} holds a mission with other settings ({what}): choose another --out, or remove that folder to start anew"
    )]
    OtherMission {
        /// The folder.
        out: PathBuf,
        /// The first setting that differs.
        what: String,
    },
    /// The mission's record cannot be parsed or serialised.
    #[error("{path}: {reason}; remove the folder to start the mission anew")]
    BadRecord {
        /// Path of the record.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The configuration of an agent cannot be serialised.
    #[error("cannot write the configuration of {device}: {reason}")]
    BadAgentConfig {
        /// The agent.
        device: DeviceId,
        /// What is wrong.
        reason: String,
    },
    /// The name of a site or device is not valid.
    #[error(transparent)]
    Name(#[from] IdError),
}

/// An edge aggregator, between some agents and the root aggregator.
#[derive(Clone, Debug)]
pub(crate) struct Edge {
    /// Device id of the edge on the root's site.
    pub(crate) device: DeviceId,
    /// The site of the edge's agents.
    pub(crate) site: SiteId,
    /// Indices of the edge's agents.
    pub(crate) agents: Range<usize>,
}

/// A mission that is ready to run.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    /// The site of the root aggregator.
    pub(crate) site: SiteId,
    /// The edge aggregators; empty if all agents send to the root.
    pub(crate) edges: Vec<Edge>,
    /// The id of each agent.
    pub(crate) devices: Vec<DeviceId>,
    /// The cell of each agent.
    pub(crate) cells: Vec<Cell>,
    /// All views in the dataset's order, each with its cell and footprint.
    pub(crate) views: Vec<AssignedView>,
}

impl Plan {
    /// Divides the dataset among the agents. Reads the mission's record from `out`, an existing folder, or writes a new
    /// record with the site `fresh_site`.
    pub(crate) fn make(
        dataset: &Dataset,
        settings: &Settings,
        out: &Path,
        fresh_site: SiteId,
    ) -> Result<Self, PlanError> {
        let (train, held_out) = dataset.split(settings.eval_every);
        let prints = footprints(dataset, &Ground::of(dataset));
        let centers: Vec<_> = train.iter().map(|&view| prints[view].center).collect();
        let edges = settings.edges.max(1);
        let mut cells = partition(&centers, edges, &settings.division)?;
        let (agents, each) = (cells.len(), cells.len() / edges);
        invite(&mut cells, &centers, settings.margin);
        let mut cell_of = vec![0; dataset.views.len()];
        for &view in &held_out {
            cell_of[view] = nearest_cell(&cells, prints[view].center);
        }
        for (i, cell) in cells.iter_mut().enumerate() {
            cell.views.iter_mut().chain(&mut cell.guests).for_each(|view| *view = train[*view]);
            cell.views.iter().for_each(|&view| cell_of[view] = i);
        }
        let views = dataset.views.iter().zip(prints).zip(cell_of).enumerate();
        let views = views.map(|(i, ((view, footprint), cell))| AssignedView {
            name: view.name.clone(),
            footprint,
            cell,
            held_out: held_out.binary_search(&i).is_ok(),
        });
        let devices = names("agent", agents)?;
        let site = open_record(settings, out, fresh_site)?;
        let edge = |(i, device): (usize, DeviceId)| {
            let site = SiteId::new(&format!("{site}-{device}"))?;
            Ok(Edge { device, site, agents: i * each..(i + 1) * each })
        };
        let edges = names("edge", settings.edges)?.into_iter().enumerate().map(edge);
        let edges = edges.collect::<Result<Vec<Edge>, IdError>>()?;
        Ok(Self { site, edges, devices, cells, views: views.collect() })
    }

    /// The site that an agent belongs to: that of its edge or, without edges, that of the root.
    fn site_of(&self, agent: usize) -> SiteId {
        self.edges.iter().find(|edge| edge.agents.contains(&agent)).map_or(self.site, |edge| edge.site)
    }

    /// Names of an agent's views. If `held_out`, these are its held-out views; otherwise the views to train on,
    /// including the views of other cells that look at the margin of its cell.
    pub(crate) fn names_of(&self, agent: usize, held_out: bool) -> Vec<String> {
        let guests = &self.cells[agent].guests;
        let its = |(i, view): &(usize, &AssignedView)| {
            view.held_out == held_out && (view.cell == agent || guests.binary_search(i).is_ok())
        };
        self.views.iter().enumerate().filter(its).map(|(_, view)| view.name.clone()).collect()
    }

    /// Writes an agent's configuration into its folder below `out`, and returns that folder. `before` is the
    /// folder of the round before: the agent begins from the global model that it received there, if it did.
    pub(crate) fn write_agent_config(
        &self,
        agent: usize,
        settings: &Settings,
        out: &Path,
        before: Option<&Path>,
        broker: &BrokerAddress,
        threads: usize,
    ) -> Result<PathBuf, PlanError> {
        let device = self.devices[agent];
        let folder_in = |out: &Path| out.join(AGENTS).join(device.as_str());
        let folder = folder_in(out);
        let init = before.map(|before| folder_in(before).join("global.ply")).filter(|init| init.is_file());
        files::create_folder(&folder)?;
        let config = AgentConfig {
            device: Some(device),
            site: self.site_of(agent),
            broker: Some(broker.clone()),
            tls: None,
            password_file: None,
            serial: None,
            baud: None,
            data: settings.data.clone(),
            out: folder.clone(),
            views: self.names_of(agent, false),
            held_out: self.names_of(agent, true),
            eval_every: settings.eval_every,
            steps: settings.steps,
            seed: settings.seed.wrapping_add(agent as u64),
            memory_bytes: settings.memory_bytes,
            max_size_px: settings.max_size_px,
            compute: None,
            threads: Some(threads),
            color_only: false,
            prune: None,
            exposure: false,
            poses: settings.poses,
            init,
            frame: None,
            key: None,
            trusted: None,
            fleet: None,
            alone: self.devices.len() == 1,
            compress: settings.compress_first,
            flights_max: DEFAULT_FLIGHTS_MAX,
            wait_global: true,
        };
        let text = toml::to_string(&config)
            .map_err(|error| PlanError::BadAgentConfig { device, reason: error.to_string() })?;
        atomic::write_bytes(&folder.join("agent.toml"), text.as_bytes())?;
        Ok(folder)
    }
}

/// Ids such as `agent-1`. The numbers are padded with zeros, so that the ids sort by number.
fn names(of: &str, count: usize) -> Result<Vec<DeviceId>, IdError> {
    let width = count.to_string().len();
    (1..=count).map(|number| DeviceId::new(&format!("{of}-{number:0width$}"))).collect()
}

/// Returns the site of the mission in `out`, from the mission's record. A record with other settings is an error once
/// agents have learnt something. If there is no record, writes one with `fresh_site`.
fn open_record(settings: &Settings, out: &Path, fresh_site: SiteId) -> Result<SiteId, PlanError> {
    let path = out.join("mission.json");
    let bad = |reason: String| PlanError::BadRecord { path: path.clone(), reason };
    match fs::read(&path) {
        Ok(bytes) => {
            let record: Record = serde_json::from_slice(&bytes).map_err(|error| bad(error.to_string()))?;
            // More memory for merges changes no result.
            let merge = MergeSettings { memory_bytes: settings.merge.memory_bytes, ..record.settings.merge };
            if (Settings { merge, ..record.settings.clone() }) == *settings {
                return Ok(record.site);
            }
            if has_learnt(out) {
                let what = difference(&record.settings, settings);
                return Err(PlanError::OtherMission { out: out.to_path_buf(), what });
            }
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        Err(cause) => return Err(SceneError::io(&path, cause).into()),
    }
    let record = Record { site: fresh_site, settings: settings.clone() };
    let text = serde_json::to_string_pretty(&record).map_err(|error| bad(error.to_string()))?;
    atomic::write_bytes(&path, text.as_bytes())?;
    Ok(fresh_site)
}

/// The folder of a round that is not the last, in that of its mission.
pub(super) fn round_folder(mission: &Path, round: u32) -> PathBuf {
    mission.join(format!("round-{round}"))
}

/// Whether an agent of the mission in `out` has learnt anything, in any round.
fn has_learnt(out: &Path) -> bool {
    let of_round = |folder: PathBuf| {
        let agents = fs::read_dir(folder.join(AGENTS)).into_iter().flatten().flatten();
        agents.into_iter().any(|agent| agent.path().join(CHECKPOINT).exists())
    };
    let earlier = (1..).map(|round| round_folder(out, round)).take_while(|folder| folder.is_dir());
    earlier.chain([out.to_owned()]).any(of_round)
}

/// A setting that differs, as `steps 300, not 500`: first the value in the record (`there`), then that of the command
/// (`here`).
fn difference(there: &Settings, here: &Settings) -> String {
    let values = |settings: &Settings| serde_json::to_value(settings).unwrap_or_default();
    let (there, here) = (values(there), values(here));
    let fields = there.as_object().into_iter().flatten();
    let differing = fields.map(|(name, value)| (name, value, &here[name])).find(|(_, a, b)| a != b);
    differing.map_or_else(String::new, |(name, there, here)| format!("{name} {there}, not {here}"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Camera, Pose, View};
    use glam::{DVec2, DVec3};

    use super::*;

    fn site(name: &str) -> SiteId {
        SiteId::new(name).unwrap()
    }

    /// Nadir views in a row from west to east.
    fn row(count: usize) -> Dataset {
        let view = |i: usize| {
            let eye = DVec3::new(i as f64 * 10.0, 0.0, 50.0);
            let camera = Camera {
                cam_from_world: Pose::look_at(eye, eye - DVec3::Z, DVec3::Y),
                focal_px: DVec2::splat(100.0),
                center_px: DVec2::splat(50.0),
                size_px: [100, 100],
            };
            View { name: format!("{i:03}.jpg"), camera, path: "x".into(), mask: None }
        };
        Dataset { views: (0..count).map(view).collect(), points: Vec::new() }
    }

    fn settings() -> Settings {
        Settings {
            data: "data".into(),
            edges: 0,
            division: Division::Evenly { agents: 2 },
            margin: 0.0,
            steps: 10,
            rounds: 1,
            memory_bytes: Some(1 << 30),
            max_size_px: None,
            poses: PoseChoice::Auto,
            seed: 7,
            eval_every: 8,
            compress_first: false,
            merge: MergeSettings::default(),
        }
    }

    #[test]
    fn every_view_has_one_agent_and_held_out_views_are_not_trained_on() {
        let out = tempfile::tempdir().unwrap();
        let plan = Plan::make(&row(18), &settings(), out.path(), site("a")).unwrap();
        assert_eq!(
            plan.names_of(0, true),
            ["000.jpg", "008.jpg"],
            "a view on the border goes to the first cell"
        );
        assert_eq!(plan.names_of(1, true), ["016.jpg"]);
        let trained: Vec<usize> = (0..2).map(|agent| plan.names_of(agent, false).len()).collect();
        assert_eq!(trained, [7, 8]);
        assert_eq!(plan.names_of(0, false)[6], "007.jpg", "from west to east");
        assert_eq!(plan.cells[1].views[0], 9, "cells hold indices into the views of the dataset");
    }

    #[test]
    fn with_a_margin_neighbours_train_on_the_same_views() {
        let out = tempfile::tempdir().unwrap();
        let settings = Settings { margin: 0.2, ..settings() };
        let plan = Plan::make(&row(18), &settings, out.path(), site("a")).unwrap();
        let names = [plan.names_of(0, false), plan.names_of(1, false)];
        let shared: Vec<&String> = names[0].iter().filter(|name| names[1].contains(name)).collect();
        assert_eq!(shared, ["007.jpg", "009.jpg"]);
        assert_eq!(plan.names_of(0, true), ["000.jpg", "008.jpg"], "held-out views have no margin");
    }

    #[test]
    fn the_written_configuration_is_what_the_agent_reads() {
        let out = tempfile::tempdir().unwrap();
        let plan = Plan::make(&row(18), &settings(), out.path(), site("a")).unwrap();
        let broker = "mqtt://h:1".parse().unwrap();
        let folder = plan.write_agent_config(1, &settings(), out.path(), None, &broker, 3).unwrap();
        let text = fs::read_to_string(folder.join("agent.toml")).unwrap();
        let config: AgentConfig = toml::from_str(&text).unwrap();
        assert_eq!((config.device, config.site.as_str()), (Some(plan.devices[1]), "a"));
        assert_eq!((config.seed, config.threads, config.memory_bytes), (8, Some(3), Some(1 << 30)));
        assert_eq!(config.views, plan.names_of(1, false));
        assert!(config.wait_global && config.out == folder);
    }

    #[test]
    fn a_single_agent_is_told_that_it_is_alone() {
        for (agents, is_alone) in [(1, true), (2, false)] {
            let out = tempfile::tempdir().unwrap();
            let settings = Settings { division: Division::Evenly { agents }, ..settings() };
            let plan = Plan::make(&row(18), &settings, out.path(), site("a")).unwrap();
            let broker = "mqtt://h:1".parse().unwrap();
            let folder = plan.write_agent_config(0, &settings, out.path(), None, &broker, 1).unwrap();
            let text = fs::read_to_string(folder.join("agent.toml")).unwrap();
            assert_eq!(toml::from_str::<AgentConfig>(&text).unwrap().alone, is_alone);
        }
    }

    #[test]
    fn agents_below_an_edge_are_on_its_site() {
        let out = tempfile::tempdir().unwrap();
        let settings = Settings { edges: 2, ..settings() };
        let plan = Plan::make(&row(20), &settings, out.path(), site("a")).unwrap();
        assert_eq!((plan.devices.len(), plan.edges.len()), (4, 2));
        let sites: Vec<String> = (0..4).map(|agent| plan.site_of(agent).to_string()).collect();
        assert_eq!(sites, ["a-edge-1", "a-edge-1", "a-edge-2", "a-edge-2"]);
        assert_eq!((plan.edges[1].device.as_str(), plan.site), ("edge-2", site("a")));
    }

    #[test]
    fn the_same_mission_resumes_and_other_settings_are_refused() {
        let out = tempfile::tempdir().unwrap();
        Plan::make(&row(18), &settings(), out.path(), site("first")).unwrap();
        let again = Plan::make(&row(18), &settings(), out.path(), site("second")).unwrap();
        assert_eq!(again.site, site("first"));
        let other = |steps| Settings { steps, ..settings() };
        let third = Plan::make(&row(18), &other(11), out.path(), site("third")).unwrap();
        assert_eq!(third.site, site("third"), "nothing had been learnt");
        for round in ["round-1", ""] {
            let checkpoint = out.path().join(round).join("agents/agent-1/checkpoint");
            fs::create_dir_all(&checkpoint).unwrap();
            let error =
                Plan::make(&row(18), &settings(), out.path(), site("fourth")).unwrap_err().to_string();
            assert!(error.contains("steps 11, not 10") && error.contains("--out"), "{error}");
            assert_eq!(
                Plan::make(&row(18), &other(11), out.path(), site("fifth")).unwrap().site,
                site("third")
            );
            fs::remove_dir(checkpoint).unwrap();
        }
    }

    #[test]
    fn names_sort_as_their_numbers_do() {
        let names = names("agent", 12).unwrap();
        assert_eq!((names[0].as_str(), names[11].as_str()), ("agent-01", "agent-12"));
        assert!(names.is_sorted());
    }
}
