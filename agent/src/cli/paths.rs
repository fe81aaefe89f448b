//! Finds the model file for an argument that may be the word `global`.

use std::path::{Path, PathBuf};

use cosurf_agent::publish::global_ply;

/// The model file that training starts from; `None` starts from the sparse cloud. The word `global` stands for the
/// global model that was received earlier and stored in the folder `out`.
pub(super) fn resolve_init(init: Option<&PathBuf>, out: &Path) -> Option<PathBuf> {
    init.map(|init| if init.as_os_str() == "global" { global_ply(out) } else { init.clone() })
}
