//! Compares the agent's own model with the model that training started from, and with the global model.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use cosurf_agent::changes::compare;
use cosurf_agent::outputs::write_json;
use cosurf_agent::session::SH_DEGREE;
use cosurf_agent::warm_start::read_visible_splats;
use cosurf_contract::{AgentEvent, ComparedWith};
use cosurf_engine::Renderer;
use cosurf_scene::{Camera, LocalFrame, Splats, files};

use crate::cli::progress::Progress;

/// The agent's own model, ready to be compared with others.
pub(super) struct Comparison<'a> {
    /// The frame of splats and cameras.
    pub(super) frame: &'a LocalFrame,
    pub(super) splats: &'a Splats,
    pub(super) cameras: &'a [Camera],
    /// Memory limit of the process, bytes.
    pub(super) memory_bytes: u64,
    pub(super) threads: usize,
    /// The agent's output folder, for the result.
    pub(super) out: &'a Path,
}

impl Comparison<'_> {
    /// Compares the agent's own model with the PLY file `other` on the ground that the agent's cameras see. Shows the
    /// result and writes it to a JSON file. Does nothing if `other` is larger than a quarter of the memory limit.
    pub(super) fn show(&self, with: ComparedWith, other: &Path, progress: &mut Progress) -> Result<()> {
        let file_bytes = fs::metadata(other).with_context(|| other.display().to_string())?.len();
        if file_bytes > self.memory_bytes / 4 {
            return Ok(());
        }
        let other = read_visible_splats(other, self.frame, self.cameras, usize::MAX, SH_DEGREE)?.splats;
        let (before, after, file) = match with {
            ComparedWith::Init => (&other, self.splats, "changes-init.json"),
            ComparedWith::Global => (self.splats, &other, "changes-global.json"),
        };
        let [mut before, mut after] = [before, after].map(|splats| Renderer::new(splats, self.threads));
        if let Some(changes) = compare(&mut before, &mut after, self.cameras) {
            let file = self.out.join(file);
            files::set_aside_unless_file(&file)?;
            write_json(&file, &changes)?;
            progress.show(&AgentEvent::Compared { with, changes });
        }
        Ok(())
    }
}
