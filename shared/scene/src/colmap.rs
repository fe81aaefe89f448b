//! COLMAP models, binary and text.

use std::path::Path;

use crate::{Dataset, SceneError};

/// Writes cameras, poses and points as a binary model into `root/sparse/0`. Pictures are not
/// copied: they belong at `root/images/NAME`.
pub fn write(root: &Path, dataset: &Dataset) -> Result<(), SceneError> {
    let _ = (root, dataset);
    unimplemented!("lands next")
}
