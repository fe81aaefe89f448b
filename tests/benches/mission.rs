//! The mission that a bench measures.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use cosurf_link::Model;
use cosurf_tests::models::read_model;

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
        self.agents.iter().map(|agent| read_model(agent)).collect()
    }
}
