//! Models that an option names by their folder or by a word.

use std::path::{Path, PathBuf};

use cosurf_agent::publish::global_ply;

/// The PLY of a finished model, given that file or the folder that training wrote.
pub(super) fn model_path(path: &Path) -> PathBuf {
    if path.is_dir() { path.join("model.ply") } else { path.to_path_buf() }
}

/// The model that training starts from. The word `global` stands for the global model that `out` received earlier.
pub(super) fn resolve_init(init: Option<&PathBuf>, out: &Path) -> Option<PathBuf> {
    init.map(|init| if init.as_os_str() == "global" { global_ply(out) } else { init.clone() })
}
