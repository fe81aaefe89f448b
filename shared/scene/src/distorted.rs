//! Opens datasets whose lenses may be distorted, for a program that undistorts the pictures.
//!
//! What it knows nothing about: how pictures are undistorted.
//!
//! Where to start reading: [`Distorted::open`].

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use crate::layout::Layout;
use crate::lens::Lens;
use crate::loader::{fit_camera, inner_name, refuse_missing};
use crate::sieve::Sieve;
use crate::{
    SceneError, Shot, SparsePoint, View, colmap, files, metashape, realitycapture, tie_points, transforms,
};

/// Most that sparse points take, bytes: about two million points. Of more, every second one is left out, and so on.
const POINTS_BYTES_MAX: usize = 256 << 20;

/// Pictures with poses, and lenses that may be distorted.
#[derive(Clone, Debug, PartialEq)]
pub enum Distorted {
    /// A model of COLMAP.
    Colmap {
        /// Folder of its files.
        model: PathBuf,
        /// Folder of its pictures.
        images: PathBuf,
    },
    /// The export of another tool.
    Shots {
        /// Folder of the pictures. The path of each shot is its name in this folder.
        images: PathBuf,
        /// The pictures that have poses.
        shots: Vec<Shot>,
        /// Whether the world is the earth-centred, earth-fixed frame (ECEF), metres.
        is_geocentric: bool,
        /// Sparse points beside the export, without tracks; empty if there are none.
        points: Vec<SparsePoint>,
        /// A file of points that are not used, and the reason.
        unused: Option<(PathBuf, String)>,
    },
}

impl Distorted {
    /// Opens a COLMAP model, a `transforms.json`, or the cameras of Metashape or RealityCapture; `path` is the file or a
    /// folder that holds it. Shots are checked as [`crate::Dataset::open`] checks views. A COLMAP model is only found.
    pub fn open(path: &Path) -> Result<Self, SceneError> {
        let root = files::folder_of(path);
        let (mut sieve, mut unused) = (Sieve::new(POINTS_BYTES_MAX), None);
        let local = |(images, shots)| (images, shots, false);
        let (images, shots, is_geocentric) = match Layout::of(path)? {
            Layout::Colmap(model) => {
                let images = colmap::picture_folder(root, &model);
                return Ok(Self::Colmap { model, images });
            }
            Layout::Transforms(file) => local((root.to_owned(), transforms::shots(&file)?)),
            Layout::Metashape(file) => {
                let cameras = metashape::read(&file)?;
                unused = tie_points::read_into(&mut sieve, &file, &cameras);
                let metashape::Cameras { shots, is_geocentric } = cameras;
                (crate::shot::picture_folder(&file), shots, is_geocentric)
            }
            Layout::RealityCaptureCsv(file) => {
                local((crate::shot::picture_folder(&file), realitycapture::read_csv(&file)?))
            }
            Layout::RealityCaptureXmp(files) => {
                let images = files[0].parent().unwrap_or(root).to_owned();
                local((images, realitycapture::read_xmp(&files)?))
            }
            Layout::OpenSfm(_) | Layout::CameraList(_) => {
                let reason = "has poses of pictures without distortion; give it to `train` as it is. Distorted pictures of OpenSfM: run `opensfm undistort` first";
                return Err(SceneError::malformed(path, reason));
            }
        };
        let shots = checked(path, &images, shots)?;
        Ok(Self::Shots { images, shots, is_geocentric, points: sieve.end().0, unused })
    }
}

/// The shots with lenses for their pictures, or why they cannot be used.
fn checked(path: &Path, images: &Path, shots: Vec<Shot>) -> Result<Vec<Shot>, SceneError> {
    let mut names = HashSet::new();
    let mut views = Vec::with_capacity(shots.len());
    for shot in &shots {
        let name =
            inner_name(&shot.name).filter(|name| images.join(name) == shot.path || !shot.path.is_file());
        let name = name.ok_or_else(|| {
            let reason = format!(
                "'{}' is not a picture in {}; put all pictures there",
                shot.name.escape_debug(),
                images.display()
            );
            SceneError::malformed(path, reason)
        })?;
        if !names.insert(name.clone()) {
            return Err(SceneError::malformed(
                path,
                format!("two pictures are called {name}; rename one of them"),
            ));
        }
        let camera = shot.lens.pinhole(shot.cam_from_world);
        views.push(View { name, camera, path: shot.path.clone(), mask: None });
    }
    if views.is_empty() {
        return Err(SceneError::malformed(path, "has no pictures with poses"));
    }
    refuse_missing(&views)?;
    views.iter_mut().try_for_each(fit_camera)?;
    let fitted = |(shot, view): (Shot, View)| {
        let lens = Lens {
            focal_px: view.camera.focal_px,
            center_px: view.camera.center_px,
            size_px: view.camera.size_px,
            ..shot.lens
        };
        Shot { name: view.name, lens, ..shot }
    };
    Ok(shots.into_iter().zip(views).map(fitted).collect())
}

#[cfg(test)]
mod tests;
