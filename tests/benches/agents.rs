//! The models of a mission's agents.

use std::fs;
use std::path::Path;

use anyhow::Result;
use cosurf_aggregator::merge::{Locals, MergeError};
use cosurf_link::Model;
use cosurf_scene::ply;

/// Models held in memory, to merge.
pub(crate) struct InMemory(pub(crate) Vec<Model>);

impl Locals for InMemory {
    fn count(&self) -> usize {
        self.0.len()
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        Ok(self.0[index].clone())
    }
}

/// Reads the model in an agent's output folder.
pub(crate) fn read(agent: &Path) -> Result<Model> {
    let splats = ply::read(&agent.join("model.ply"))?;
    let cameras = serde_json::from_slice(&fs::read(agent.join("cameras.json"))?)?;
    Ok(Model { splats, cameras })
}
