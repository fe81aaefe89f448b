//! `cameras.json`: the world cameras of a model, as training and merging write it.
//!
//! It is a list of [`Camera`]s, with quaternions as x y z w. A folder of a model has no pictures, and no names for them.

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::{Camera, SceneError, View, atomic, files};

/// Name of the file in a model's folder.
pub const FILE: &str = "cameras.json";

/// Reads world cameras. Errors: no such list, or a camera without pixels or focal lengths.
pub fn read(path: &Path) -> Result<Vec<Camera>, SceneError> {
    let bytes = files::read(path)?;
    let cameras: Vec<Camera> =
        serde_json::from_slice(&bytes).map_err(|error| SceneError::malformed(path, error.to_string()))?;
    let is_usable = |camera: &Camera| {
        let focal_px = camera.focal_px;
        !camera.size_px.contains(&0) && focal_px.is_finite() && focal_px.min_element() > 0.0
    };
    if let Some(i) = cameras.iter().position(|camera| !is_usable(camera)) {
        let reason = format!("camera {i} has no pixels, or a focal length that is not above 0");
        return Err(SceneError::malformed(path, reason));
    }
    Ok(cameras)
}

/// Writes world cameras, atomically.
pub fn write(path: &Path, cameras: &[Camera]) -> Result<(), SceneError> {
    atomic::write(path, |file| {
        serde_json::to_writer_pretty(&mut *file, cameras)?;
        writeln!(file)
    })
}

/// Reads world cameras as views, numbered from 1 and without pictures.
pub(crate) fn read_views(path: &Path) -> Result<Vec<View>, SceneError> {
    let view =
        |(i, camera)| View { name: format!("camera-{:04}", i + 1), camera, path: PathBuf::new(), mask: None };
    Ok(read(path)?.into_iter().enumerate().map(view).collect())
}
