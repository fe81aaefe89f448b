//! Splats as PLY in the layout of the original 3DGS code, which viewers and other trainers open.

use std::path::Path;

use crate::{SceneError, Splats};

/// Writes `splats` as a binary little-endian PLY, atomically.
pub fn write(path: &Path, splats: &Splats) -> Result<(), SceneError> {
    let _ = (path, splats);
    unimplemented!("lands next")
}

/// Reads splats. What comes back holds no bad value ([`Splats::find_bad_value`]).
pub fn read(path: &Path) -> Result<Splats, SceneError> {
    let _ = path;
    unimplemented!("lands next")
}
