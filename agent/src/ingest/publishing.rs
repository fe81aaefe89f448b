//! Writes the dataset: the reconstruction in its place, with its pictures.

use std::fs;
use std::io;
use std::path::Path;

use cosurf_contract::IngestReport;
use cosurf_geo::Georeference;
use cosurf_scene::{Dataset, SceneError, atomic, colmap, files};
use serde::{Deserialize, Serialize};

use super::error::IngestError;
use super::stages::remove;

/// Tells what a finished dataset was made of.
const FINISHED: &str = "ingest.json";

/// Writes `sparse/0`, `images`, `masks` if there are any, and `geo.json` if the place is known, into the folder `out`. `work`
/// is a folder on the same disk for what is not complete.
pub(super) fn publish(
    out: &Path,
    work: &Path,
    dataset: &Dataset,
    georeference: Option<&Georeference>,
) -> Result<(), IngestError> {
    let geo = out.join(Georeference::FILE);
    remove(&geo)?; // until it is true again
    let pictures = dataset.views.iter().map(|view| (view.name.as_str(), view.path.as_path()));
    write_pictures(&out.join("images"), work, pictures)?;
    let masked = dataset
        .views
        .iter()
        .filter_map(|view| Some((view.name.as_str(), view.mask.as_ref()?.path.as_path())));
    write_pictures(&out.join("masks"), work, masked)?;
    colmap::write(out, dataset)?;
    if let Some(georeference) = georeference {
        atomic::write_bytes(&geo, georeference.to_json().as_bytes())?;
    }
    Ok(())
}

/// Where the poses of a dataset come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Poses {
    /// COLMAP found them here.
    #[default]
    Found,
    /// Another tool found them.
    Given,
}

/// What a dataset was made of: the content of `ingest.json`.
#[derive(Serialize)]
struct Origin<'a> {
    photographs_folder: &'a Path,
    report: &'a IngestReport,
    poses: Poses,
}

/// What [`is_finished`] reads of it.
#[derive(Deserialize)]
struct Noted {
    #[serde(default)]
    poses: Poses,
}

/// Notes what a published dataset was made of, so that a later run knows it for one of ours.
pub(super) fn finish(
    out: &Path,
    photographs: &Path,
    report: &IngestReport,
    poses: Poses,
) -> Result<(), IngestError> {
    let origin = Origin { photographs_folder: photographs, report, poses };
    let path = out.join(FINISHED);
    let json = serde_json::to_vec_pretty(&origin);
    let json = json.map_err(|error| SceneError::io(&path, error.into()))?;
    Ok(atomic::write_bytes(&path, &json)?)
}

/// Whether a folder has a dataset that was made of photographs, with poses from there.
pub(super) fn is_finished(out: &Path, poses: Poses) -> bool {
    let noted = || serde_json::from_slice::<Noted>(&fs::read(out.join(FINISHED)).ok()?).ok();
    noted().is_some_and(|noted| noted.poses == poses)
}

/// Replaces a folder of pictures, given by name and file, in one step. Without pictures, there is no folder.
fn write_pictures<'a>(
    images: &Path,
    work: &Path,
    pictures: impl Iterator<Item = (&'a str, &'a Path)>,
) -> Result<(), IngestError> {
    let (new, old) = (work.join("images.new"), work.join("images.old"));
    remove(&new)?;
    remove(&old)?;
    for (name, path) in pictures {
        let to = new.join(name);
        let folder = to.parent().unwrap_or(&new);
        files::create_folder(folder)?;
        link_or_copy(path, &to).map_err(|cause| SceneError::io(&to, cause))?;
    }
    let rename = |from: &Path, to: &Path| fs::rename(from, to).map_err(|cause| SceneError::io(to, cause));
    if images.is_dir() {
        rename(images, &old)?;
    }
    if new.is_dir() {
        rename(&new, images)?;
    }
    remove(&old)
}

/// A second name for a file, or a copy where the disk has no second names.
pub(super) fn link_or_copy(from: &Path, to: &Path) -> io::Result<()> {
    fs::hard_link(from, to).or_else(|_| fs::copy(from, to).map(|_| ()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Camera, Pose, View};
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    #[test]
    fn pictures_of_an_earlier_run_are_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let (out, work) = (folder.path().join("out"), folder.path().join("work"));
        fs::create_dir_all(out.join("images")).unwrap();
        fs::write(out.join("images/stale.jpg"), "of an earlier run").unwrap();
        fs::create_dir_all(out.join("masks")).unwrap();
        fs::write(out.join(Georeference::FILE), "of an earlier run").unwrap();
        let picture = folder.path().join("a ü.jpg");
        fs::write(&picture, "pixels").unwrap();
        let camera = Camera {
            cam_from_world: Pose { rotation: DQuat::IDENTITY, translation: DVec3::Z },
            focal_px: DVec2::splat(500.0),
            center_px: DVec2::new(320.0, 240.0),
            size_px: [640, 480],
        };
        let view = View { name: "100MEDIA/a ü.jpg".into(), camera, path: picture, mask: None };
        let dataset = Dataset { views: vec![view], points: Vec::new() };
        publish(&out, &work, &dataset, None).unwrap();
        assert_eq!(fs::read(out.join("images/100MEDIA/a ü.jpg")).unwrap(), b"pixels");
        assert!(!out.join("images/stale.jpg").exists() && !out.join("masks").exists());
        assert!(!out.join(Georeference::FILE).exists());
        let read = |name: &str| fs::read(out.join("sparse/0").join(name)).unwrap();
        let files = [read("cameras.bin"), read("images.bin"), read("points3D.bin")];
        let written = colmap::parse(colmap::Form::Binary, [&files[0], &files[1], &files[2]]).unwrap();
        assert_eq!(written.views[0].camera, camera);
    }
}
