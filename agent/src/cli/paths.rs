//! Finds the model file for an argument that names a folder, or that is the word `global`.

use std::path::{Path, PathBuf};

use cosurf_agent::publish::global_ply;

/// The PLY file of a trained model: `model.ply` in `path` if that is a folder, otherwise `path` itself.
pub(super) fn model_path(path: &Path) -> PathBuf {
    if path.is_dir() { path.join("model.ply") } else { path.to_path_buf() }
}

/// The model file that training starts from; `None` starts from the sparse cloud. The word `global` stands for the
/// global model that was received earlier and stored in the folder `out`.
pub(super) fn resolve_init(init: Option<&PathBuf>, out: &Path) -> Option<PathBuf> {
    init.map(|init| if init.as_os_str() == "global" { global_ply(out) } else { init.clone() })
}
