//! COLMAP models, binary and text: `cameras`, `images` and `points3D`.
//!
//! Cameras must be `PINHOLE` or `SIMPLE_PINHOLE`: splats are projected without lens distortion, so
//! pictures are undistorted once, by COLMAP itself, whose command the refusal spells out. Frames and
//! pixels are as in [`crate::camera`]; quaternions are stored as wxyz.

mod binary;
mod model;
#[cfg(test)]
mod tests;
mod text;
mod write;

use std::path::{Path, PathBuf};

use crate::{Dataset, SceneError};
use model::Undistortion;
pub use write::write;

/// The folder of the model that belongs to `root`, if there is one.
pub(crate) fn find_model(root: &Path) -> Option<PathBuf> {
    let candidates = [root.join("sparse").join("0"), root.join("sparse"), root.join("0"), root.to_owned()];
    candidates.into_iter().find(|folder| is_binary(folder) || folder.join("cameras.txt").is_file())
}

fn is_binary(model: &Path) -> bool {
    model.join("cameras.bin").is_file()
}

/// Where the pictures of the model in the folder `model` may lie, best first.
fn picture_folders(root: &Path, model: &Path) -> Vec<PathBuf> {
    let above = model.ancestors().skip(1).take(2).map(|above| above.join("images"));
    std::iter::once(root.join("images")).chain(above).collect()
}

/// Reads the model in the folder `model`. Views come in the file's order, their paths are where
/// their pictures should be; it was not looked whether they are there.
pub(crate) fn read(root: &Path, model: &Path) -> Result<Dataset, SceneError> {
    let folders = picture_folders(root, model);
    let likely = folders.iter().find(|folder| folder.is_dir()).unwrap_or(&folders[0]);
    let undistortion = Undistortion { images: likely, model, root };
    let read = if is_binary(model) { binary::read } else { text::read };
    let mut dataset = read(model, &undistortion)?;
    let first = dataset.views.first().map_or("", |view| &view.name);
    let beside = root.to_owned();
    let holds_first = |folder: &&PathBuf| folder.join(first).is_file();
    let folder = folders.iter().chain([&beside]).find(holds_first).unwrap_or(likely).clone();
    for view in &mut dataset.views {
        view.path = folder.join(&view.name);
    }
    Ok(dataset)
}
