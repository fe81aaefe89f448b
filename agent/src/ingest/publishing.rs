//! Writes the dataset: the reconstruction in its place, with its pictures.

use std::fs;
use std::io;
use std::path::Path;

use cosurf_geo::{Georeference, Similarity};
use cosurf_scene::{Dataset, Pose, SceneError, atomic, colmap};

use super::error::IngestError;
use super::stages::remove;

/// Writes `sparse/0`, `images` and, if the place is known, `geo.json` into the folder `out`. `work` is a folder on the same
/// disk for what is not complete.
pub(super) fn publish(
    out: &Path,
    work: &Path,
    mut dataset: Dataset,
    similarity: &Similarity,
    georeference: Option<&Georeference>,
) -> Result<(), IngestError> {
    place(&mut dataset, similarity);
    let geo = out.join(Georeference::FILE);
    remove(&geo)?; // until it is true again
    write_pictures(&out.join("images"), work, &dataset)?;
    colmap::write(out, &dataset)?;
    if let Some(georeference) = georeference {
        atomic::write_bytes(&geo, georeference.to_json().as_bytes())?;
    }
    Ok(())
}

/// Moves cameras and points.
fn place(dataset: &mut Dataset, similarity: &Similarity) {
    for view in &mut dataset.views {
        let Pose { rotation, translation } = view.camera.cam_from_world;
        let rotation = (rotation * similarity.rotation.inverse()).normalize();
        let translation = similarity.scale * translation - rotation * similarity.translation;
        view.camera.cam_from_world = Pose { rotation, translation };
    }
    dataset.points.iter_mut().for_each(|point| point.position = similarity.apply(point.position));
}

/// Replaces the folder of pictures in one step.
fn write_pictures(images: &Path, work: &Path, dataset: &Dataset) -> Result<(), IngestError> {
    let (new, old) = (work.join("images.new"), work.join("images.old"));
    remove(&new)?;
    remove(&old)?;
    for view in &dataset.views {
        let to = new.join(&view.name);
        let folder = to.parent().unwrap_or(&new);
        fs::create_dir_all(folder).map_err(|cause| SceneError::io(folder, cause))?;
        link_or_copy(&view.path, &to).map_err(|cause| SceneError::io(&to, cause))?;
    }
    let rename = |from: &Path, to: &Path| fs::rename(from, to).map_err(|cause| SceneError::io(to, cause));
    if images.is_dir() {
        rename(images, &old)?;
    }
    rename(&new, images)?;
    remove(&old)
}

/// A second name for a file, or a copy where the disk has no second names.
fn link_or_copy(from: &Path, to: &Path) -> io::Result<()> {
    fs::hard_link(from, to).or_else(|_| fs::copy(from, to).map(|_| ()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Camera, SparsePoint, View};
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    #[test]
    fn pictures_show_the_same_after_the_move() {
        let folder = tempfile::tempdir().unwrap();
        let (out, work) = (folder.path().join("out"), folder.path().join("work"));
        fs::create_dir_all(&out).unwrap();
        fs::create_dir_all(out.join("images")).unwrap();
        fs::write(out.join("images/stale.jpg"), "of an earlier run").unwrap();
        let picture = folder.path().join("a ü.jpg");
        fs::write(&picture, "pixels").unwrap();
        let camera = Camera {
            cam_from_world: Pose {
                rotation: DQuat::from_xyzw(0.1, 0.2, -0.3, 0.9).normalize(),
                translation: DVec3::new(0.1, 0.2, 3.0),
            },
            focal_px: DVec2::splat(500.0),
            center_px: DVec2::new(320.0, 240.0),
            size_px: [640, 480],
        };
        let view = View { name: "100MEDIA/a ü.jpg".into(), camera, path: picture };
        let points =
            vec![SparsePoint { position: DVec3::new(0.3, -0.1, 1.0), rgb: [1, 2, 3], views: vec![0] }];
        let before = camera.project_with_depth(points[0].position).unwrap();
        let similarity = Similarity {
            scale: 11.0,
            rotation: DQuat::from_rotation_x(2.0),
            translation: DVec3::new(5.0, 6.0, 7.0),
        };
        publish(&out, &work, Dataset { views: vec![view], points }, &similarity, None).unwrap();
        assert_eq!(fs::read(out.join("images/100MEDIA/a ü.jpg")).unwrap(), b"pixels");
        assert!(!out.join("images/stale.jpg").exists());
        assert!(!out.join(Georeference::FILE).exists());
        let read = |name: &str| fs::read(out.join("sparse/0").join(name)).unwrap();
        let files = [read("cameras.bin"), read("images.bin"), read("points3D.bin")];
        let written = colmap::parse(colmap::Form::Binary, [&files[0], &files[1], &files[2]]).unwrap();
        let (after_px, after_depth) =
            written.views[0].camera.project_with_depth(written.points[0].position).unwrap();
        assert!(after_px.distance(before.0) < 1e-9);
        assert!((after_depth - 11.0 * before.1).abs() < 1e-9);
    }
}
