//! Finds the model file for an argument that may be the word `global`.

use std::path::{Path, PathBuf};

use cosurf_agent::publish::global_ply;
use cosurf_scene::ply;

/// The model file that training starts from; `None` starts from the sparse cloud. The word `global` stands for the
/// global model that was received earlier and stored in the folder `out`. The folder of a training or mission stands for
/// its model.
pub(super) fn resolve_init(init: Option<&PathBuf>, out: &Path) -> Option<PathBuf> {
    init.map(|init| match init.as_os_str() == "global" {
        true => global_ply(out),
        // What holds no model stays, so that the error names it.
        false => ply::of_model(init).unwrap_or_else(|_| init.clone()),
    })
}
