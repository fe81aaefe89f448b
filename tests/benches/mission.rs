//! The mission that a bench measures.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use cosurf_link::Model;
use cosurf_scene::ply;

/// A mission: its dataset and the models of its agents.
#[derive(Args)]
pub(crate) struct Mission {
    /// Folder of the mission's dataset
    pub(crate) data: PathBuf,
    /// Output folders of the mission's agents
    #[arg(required = true)]
    pub(crate) agents: Vec<PathBuf>,
    /// Name of the dataset in the results
    #[arg(long, default_value = "mission")]
    pub(crate) name: String,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

impl Mission {
    /// Reads the models of all agents.
    pub(crate) fn models(&self) -> Result<Vec<Model>> {
        self.agents.iter().map(|agent| read(agent)).collect()
    }
}

/// Reads the model in an agent's output folder.
pub(crate) fn read(agent: &Path) -> Result<Model> {
    let splats = ply::read(&agent.join("model.ply"))?;
    let cameras = serde_json::from_slice(&fs::read(agent.join("cameras.json"))?)?;
    Ok(Model { splats, cameras })
}
