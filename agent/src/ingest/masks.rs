//! The masks of photographs on their way through COLMAP: it finds no features in what they hide, and undistorts them like
//! photographs.
//!
//! COLMAP wants a mask of the size of its photograph, called as the photograph with `.png` behind; its undistorter wants
//! pictures with the names of the photographs.

use std::fs;
use std::path::{Path, PathBuf};

use cosurf_scene::{Picture, SceneError, Shrinking, files, mask};

use super::error::IngestError;
use super::photographs::{Photograph, Photographs, reason};
use super::stages::remove;

/// The folder of the masks as COLMAP wants them for features.
pub(super) fn folder(work: &Path) -> PathBuf {
    work.join("masks")
}

/// The folder of the masks under the names of the photographs.
pub(super) fn as_pictures(work: &Path) -> PathBuf {
    work.join("masks-as-pictures")
}

/// The folder in which COLMAP undistorts the masks.
pub(super) fn undistorted(work: &Path) -> PathBuf {
    work.join("undistorted-masks")
}

/// Writes the masks of all photographs if any has one; a photograph without a mask gets a white one. Photographs whose mask
/// cannot be used are left out.
pub(super) fn prepare(mut photographs: Photographs, work: &Path) -> Result<Photographs, IngestError> {
    remove(&folder(work))?;
    remove(&as_pictures(work))?;
    if photographs.usable.iter().all(|photograph| photograph.mask.is_none()) {
        return Ok(photographs);
    }
    let mut usable = Vec::new();
    for photograph in std::mem::take(&mut photographs.usable) {
        match shown(&photographs.folder, &photograph) {
            Ok(shown) => {
                write(&shown, &photograph.name, work)?;
                usable.push(photograph);
            }
            Err(error) => {
                photographs.left_out.push((photograph.name, format!("its mask {}", reason(&error))))
            }
        }
    }
    photographs.usable = usable;
    photographs.enough()
}

/// Lays the undistorted masks beside the undistorted pictures of `dataset`, if COLMAP made any.
pub(super) fn join(work: &Path, dataset: &Path) -> Result<(), IngestError> {
    let (from, to) = (undistorted(work).join("images"), dataset.join("masks"));
    if from.is_dir() {
        remove(&to)?;
        fs::rename(&from, &to).map_err(|cause| SceneError::io(&to, cause))?;
    }
    Ok(())
}

/// A picture of the photograph's size, white where it counts and black elsewhere.
fn shown(folder: &Path, photograph: &Photograph) -> Result<Picture, SceneError> {
    let Photograph { name, size_px, mask, .. } = photograph;
    let Some((mask, _)) = mask else {
        let [width, height] = size_px.map(|side| side as usize);
        return Ok(Picture::new(*size_px, vec![255; 3 * width * height]));
    };
    let picture = mask::read(&folder.join(name), Some(mask), *size_px, Shrinking::AfterDecoding)?;
    let white = picture.counted().flat_map(|counts| [if counts { 255 } else { 0 }; 3]);
    Ok(Picture::new(*size_px, white.collect()))
}

fn write(shown: &Picture, name: &str, work: &Path) -> Result<(), IngestError> {
    let mask = folder(work).join(format!("{name}.png"));
    let as_picture = as_pictures(work).join(name);
    for path in [&mask, &as_picture] {
        let folder = path.parent().unwrap_or(work);
        files::create_folder(folder)?;
    }
    shown.write_png(&mask)?;
    fs::hard_link(&mask, &as_picture)
        .or_else(|_| fs::copy(&mask, &as_picture).map(|_| ()))
        .map_err(|cause| SceneError::io(&as_picture, cause).into())
}
