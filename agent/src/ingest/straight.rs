//! Pictures of lenses that COLMAP does not know are undistorted here, before COLMAP shrinks them with the others.

use std::fs;
use std::path::{Path, PathBuf};

use cosurf_contract::{AgentEvent, IngestStage};
use cosurf_scene::{SceneError, Shot, atomic, files};

use super::error::IngestError;
use super::publishing::link_or_copy;
use super::stages::remove;

/// The folder of the pictures, and shots with lenses that COLMAP knows. If it does not know all lenses already, all
/// pictures of the folder `images` are written to a folder in `work`: those of unknown lenses without their distortion, the
/// others as they are. `key` is a hash of the shots: the pictures of an earlier run with the same one are taken.
pub(super) fn prepare(
    shots: &[Shot],
    images: &Path,
    work: &Path,
    key: &blake3::Hash,
    tell: &mut dyn FnMut(AgentEvent),
) -> Result<(PathBuf, Vec<Shot>), IngestError> {
    let (folder, stamp) = (work.join("straight"), work.join("straight.stamp"));
    let mut unknown = Vec::new();
    for shot in shots {
        unknown.extend(shot.straight(&folder)?.map(|straight| (shot, straight)));
    }
    if unknown.is_empty() {
        return Ok((images.to_owned(), shots.to_vec()));
    }
    let known = || shots.iter().filter(|shot| shot.lens.is_known_to_colmap());
    if !fs::read(&stamp).is_ok_and(|found| found == key.to_hex().as_bytes()) {
        remove(&stamp)?;
        remove(&folder)?;
        for (done, (shot, straight)) in unknown.iter().enumerate() {
            told(done, unknown.len(), tell);
            create_folder_of(&straight.path)?;
            shot.write_straight(straight)?;
        }
        for shot in known() {
            let to = folder.join(&shot.name);
            create_folder_of(&to)?;
            link_or_copy(&shot.path, &to).map_err(|cause| SceneError::io(&to, cause))?;
        }
        atomic::write_bytes(&stamp, key.to_hex().as_bytes())?;
        told(unknown.len(), unknown.len(), tell);
    }
    let all = known().cloned().chain(unknown.iter().map(|(_, straight)| straight.clone())).collect();
    Ok((folder, all))
}

fn told(done: usize, of: usize, tell: &mut dyn FnMut(AgentEvent)) {
    let stage = IngestStage::Undistorting;
    tell(AgentEvent::Ingesting { stage, done, of, seconds_left: None, resumed: false });
}

fn create_folder_of(path: &Path) -> Result<(), SceneError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    files::create_folder(folder)
}
