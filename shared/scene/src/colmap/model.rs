//! The part that the readers of the binary and the text form share: checks the records, which refer to
//! each other by id, and turns them into a [`Dataset`].

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec2, DVec3};

use crate::error::Refusal;
use crate::sieve::Sieve;
use crate::{Camera, Pose, SceneError, SparsePoint, View};

/// Largest accepted width or height of a picture, pixels. COLMAP stores both as 64-bit numbers, so a
/// damaged file can claim any size.
const SIDE_PX_MAX: u64 = 1 << 20;

/// The paths in the COLMAP command that undistorts a model's pictures.
pub(super) struct Undistortion<'a> {
    pub(super) images: &'a Path,
    pub(super) model: &'a Path,
    pub(super) root: &'a Path,
}

impl Undistortion<'_> {
    /// The COLMAP command, for a POSIX shell.
    fn command(&self) -> String {
        format!(
            "colmap image_undistorter --image_path {} --input_path {} --output_path {} --output_type COLMAP",
            quoted(self.images),
            quoted(self.model),
            quoted(&self.output()),
        )
    }

    fn output(&self) -> PathBuf {
        self.root.join("undistorted")
    }
}

/// Quotes a path if necessary, so that a POSIX shell reads it as one word.
fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "/._-+,:@%".contains(c);
    if text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

/// A camera without its pose.
#[derive(Clone, Copy)]
pub(super) struct Intrinsics {
    focal_px: DVec2,
    center_px: DVec2,
    size_px: [u32; 2],
}

impl Intrinsics {
    /// Intrinsics from the name and the parameters of a COLMAP camera model. Errors: a model other
    /// than the two pinhole models with a distortion that is not 0; a size, focal length or centre that is invalid or not finite.
    pub(super) fn new(
        model: &str,
        size_px: [u64; 2],
        params: &[f64],
        undistortion: &Undistortion,
    ) -> Result<Self, Refusal> {
        let (focal_px, center_px) = match (model, params) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => (DVec2::splat(f), DVec2::new(cx, cy)),
            ("PINHOLE", &[fx, fy, cx, cy]) => (DVec2::new(fx, fy), DVec2::new(cx, cy)),
            ("SIMPLE_PINHOLE" | "PINHOLE", _) => {
                return Err(format!("{model} with {} parameters", params.len()).into());
            }
            // A lens without distortion is a pinhole. The parameters of these models begin alike.
            ("SIMPLE_RADIAL" | "RADIAL", &[f, cx, cy, ref distortion @ ..]) if is_zero(distortion) => {
                (DVec2::splat(f), DVec2::new(cx, cy))
            }
            ("OPENCV" | "FULL_OPENCV", &[fx, fy, cx, cy, ref distortion @ ..]) if is_zero(distortion) => {
                (DVec2::new(fx, fy), DVec2::new(cx, cy))
            }
            _ => return Err(refuse_distortion(model, undistortion)),
        };
        if size_px.iter().any(|side| !(1..=SIDE_PX_MAX).contains(side)) {
            return Err(format!("the picture size {} × {} pixels is invalid", size_px[0], size_px[1]).into());
        }
        if !(focal_px.min_element() > 0.0 && focal_px.is_finite() && center_px.is_finite()) {
            return Err(format!("the focal length {focal_px} px or centre {center_px} px is invalid").into());
        }
        Ok(Self { focal_px, center_px, size_px: size_px.map(|side| side as u32) })
    }
}

fn is_zero(distortion: &[f64]) -> bool {
    distortion.iter().all(|value| *value == 0.0)
}

/// The error for a camera model other than the two pinhole models.
pub(super) fn refuse_distortion(model: &str, undistortion: &Undistortion) -> Refusal {
    format!(
        "the camera model {model} is not supported, only PINHOLE and SIMPLE_PINHOLE; undistort the pictures with `{}` and open {}",
        undistortion.command(),
        undistortion.output().display(),
    )
    .into()
}

/// A record of the file `images`: a picture with its pose.
pub(super) struct Image {
    pub(super) id: u32,
    pub(super) camera_id: u32,
    pub(super) cam_from_world: Pose,
    pub(super) name: String,
}

/// A pose from COLMAP's numbers: a quaternion wxyz, longer than 1e-6, and a translation. The
/// quaternion is normalised.
pub(super) fn pose(wxyz: [f64; 4], translation: [f64; 3]) -> Result<Pose, Refusal> {
    let [w, x, y, z] = wxyz;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let translation = DVec3::from(translation);
    let length = rotation.length();
    if !(length.is_finite() && length > 1e-6 && translation.is_finite()) {
        return Err(format!("its pose {wxyz:?} {translation} is invalid").into());
    }
    Ok(Pose { rotation: rotation.normalize(), translation })
}

/// A record of the file `points3D`: a 3D point, and its track as a list of image ids.
pub(super) struct Point {
    pub(super) position: [f64; 3],
    pub(super) rgb: [u8; 3],
    pub(super) image_ids: Vec<u32>,
}

/// Collects the records of the three files, which must come in this order: cameras, images, points.
pub(super) struct Assembly<'a> {
    cameras: HashMap<u32, Intrinsics>,
    /// Index of the view for each image id.
    view_of: HashMap<u32, u32>,
    views: Vec<View>,
    points: &'a mut Sieve,
}

impl<'a> Assembly<'a> {
    pub(super) fn new(points: &'a mut Sieve) -> Self {
        Self { cameras: HashMap::new(), view_of: HashMap::new(), views: Vec::new(), points }
    }

    pub(super) fn add_camera(&mut self, id: u32, camera: Intrinsics) -> Result<(), Refusal> {
        match self.cameras.insert(id, camera) {
            None => Ok(()),
            Some(_) => Err(format!("the camera id {id} occurs twice").into()),
        }
    }

    pub(super) fn add_image(&mut self, image: Image) -> Result<(), Refusal> {
        let Some(camera) = self.cameras.get(&image.camera_id) else {
            return Err(format!("{} refers to the unknown camera {}", image.name, image.camera_id).into());
        };
        let &Intrinsics { focal_px, center_px, size_px } = camera;
        let camera = Camera { cam_from_world: image.cam_from_world, focal_px, center_px, size_px };
        if self.view_of.insert(image.id, self.views.len() as u32).is_some() {
            return Err(format!("the image id {} occurs twice", image.id).into());
        }
        self.views.push(View { name: image.name, camera, path: PathBuf::new(), mask: None });
        Ok(())
    }

    /// Adds a point. Image ids in its track that the model lacks are skipped: some tools remove images
    /// from a model but not from its tracks.
    pub(super) fn add_point(&mut self, point: Point) -> Result<(), Refusal> {
        let position = DVec3::from(point.position);
        if !position.is_finite() {
            return Err(format!("its position {position} is not finite").into());
        }
        let mut views: Vec<u32> =
            point.image_ids.iter().filter_map(|id| self.view_of.get(id).copied()).collect();
        views.sort_unstable();
        views.dedup();
        self.points.add(SparsePoint { position, rgb: point.rgb, views });
        Ok(())
    }

    pub(super) fn end(self) -> Vec<View> {
        self.views
    }
}

/// Runs `read` on the file `name` in the folder `model`, and adds the file's path to its errors.
pub(super) fn with_file(
    model: &Path,
    name: &str,
    read: impl FnOnce(&Path) -> Result<(), Refusal>,
) -> Result<(), SceneError> {
    let path = model.join(name);
    read(&path).map_err(|refusal| refusal.of(&path))
}
