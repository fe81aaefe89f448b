//! Reads the `transforms.json` of nerfstudio and instant-ngp. The file has a pose for each frame
//! (picture), and intrinsics for all frames together or for single frames.
//!
//! The file's poses are `world_from_cam` with OpenGL's camera axes (x right, y up, z backward). A
//! [`Pose`] is `cam_from_world` with y down and z forward. The world frame stays that of the file.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::Deserialize;

use crate::error::Refusal;
use crate::sieve::Sieve;
use crate::{Camera, Picture, Pose, SceneError, View, files, mask_files, ply};

/// Longest accepted file, bytes; 10,000 frames take about 10 MB.
const FILE_BYTES_MAX: u64 = 1 << 28;

/// How far the axes of a pose may deviate from unit length and right angles: the largest accepted
/// entry of `RᵀR - I`, where `R` is the rotation.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Extensions to append if `file_path` names no file: the files of instant-ngp leave the extension
/// out.
const EXTENSIONS: [&str; 9] = ["png", "jpg", "jpeg", "webp", "tif", "tiff", "bmp", "JPG", "PNG"];

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    shared: Intrinsics,
    frames: Vec<Frame>,
    /// PLY file of the sparse cloud, in the world frame of the poses. The path is relative to the
    /// folder of the `transforms.json`.
    ply_file_path: Option<PathBuf>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<[f64; 4]>,
    /// The picture's mask, in which white pixels count.
    mask_path: Option<PathBuf>,
    #[serde(flatten)]
    own: Intrinsics,
}

/// Intrinsics for all frames or for one frame, under the names in the file. Sizes, focal lengths and
/// centres are in pixels.
#[derive(Clone, Deserialize)]
struct Intrinsics {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    /// Horizontal field of view, radians.
    camera_angle_x: Option<f64>,
    /// Vertical field of view, radians.
    camera_angle_y: Option<f64>,
    // Coefficients of lens distortion; all must be 0.
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

/// Reads the file at `path`, and its points into `sieve`. Views keep the file's order. The pictures may be missing, unless
/// the file omits their sizes.
pub(crate) fn read(path: &Path, sieve: &mut Sieve) -> Result<Vec<View>, SceneError> {
    let transforms = parse(path).map_err(|refusal| refusal.of(path))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let view = |frame| view_of(folder, &transforms.shared, frame).map_err(|refusal| refusal.of(path));
    let views = transforms.frames.iter().map(view).collect::<Result<_, _>>()?;
    if let Some(cloud) = &transforms.ply_file_path {
        ply::read_points_into(sieve, &folder.join(cloud))?;
    }
    Ok(views)
}

fn parse(path: &Path) -> Result<Transforms, Refusal> {
    let file = File::open(path)?;
    if file.metadata()?.len() > FILE_BYTES_MAX {
        return Err("is longer than 256 MiB, too long for a transforms.json".into());
    }
    serde_json::from_reader(BufReader::new(file))
        .map_err(|error| format!("is not a valid transforms.json: {error}").into())
}

fn view_of(folder: &Path, shared: &Intrinsics, frame: &Frame) -> Result<View, Refusal> {
    let path = picture_path(folder, &frame.file_path);
    let camera = || {
        let intrinsics = frame.own.over(shared);
        intrinsics.refuse_distortion()?;
        intrinsics.camera(pose(&frame.transform_matrix)?, &path)
    };
    let camera =
        camera().map_err(|refusal| refusal.at(format_args!("frame {}", frame.file_path.escape_debug())))?;
    let mask = frame.mask_path.as_ref().map(|mask| mask_files::named(folder.join(mask)));
    Ok(View { name: frame.file_path.clone(), camera, path, mask })
}

/// The path of a frame's picture. If no such file exists, appends the first of [`EXTENSIONS`] that gives
/// an existing file, or nothing if none does.
fn picture_path(folder: &Path, file_path: &str) -> PathBuf {
    let path = files::in_any_case(folder.join(file_path));
    if path.is_file() {
        return path;
    }
    let with = |extension: &&str| PathBuf::from(format!("{}.{extension}", path.display()));
    EXTENSIONS.iter().map(with).find(|path| path.is_file()).unwrap_or(path)
}

/// Converts the rows of `world_from_cam`, with OpenGL's camera axes, to a pose.
fn pose(rows: &[[f64; 4]]) -> Result<Pose, Refusal> {
    let (first, last) = rows.split_at(rows.len().min(3));
    let &[x, y, z] = first else { return Err("transform_matrix has fewer than 3 rows".into()) };
    if !matches!(last, [] | [[0.0, 0.0, 0.0, 1.0]]) {
        return Err("transform_matrix does not end with the row 0 0 0 1".into());
    }
    // The columns of the matrix are the camera's axes and its centre, in world coordinates. The y and
    // z axes are reversed.
    let column = |i: usize| DVec3::new(x[i], y[i], z[i]);
    let world_from_cam = DMat3::from_cols(column(0), -column(1), -column(2));
    let residual = world_from_cam.transpose() * world_from_cam - DMat3::IDENTITY;
    let is_rotation = residual.to_cols_array().iter().all(|v| v.abs() < ROTATION_TOLERANCE);
    let center = column(3);
    if !(is_rotation && world_from_cam.determinant() > 0.0 && center.is_finite()) {
        return Err("transform_matrix is not a rotation and translation".into());
    }
    let rotation = DQuat::from_mat3(&world_from_cam.transpose()).normalize();
    Ok(Pose { rotation, translation: -(rotation * center) })
}

impl Intrinsics {
    /// These intrinsics, with missing values taken from `shared`.
    fn over(&self, shared: &Self) -> Self {
        let own = self.clone();
        let shared = shared.clone();
        Self {
            camera_model: own.camera_model.or(shared.camera_model),
            is_fisheye: own.is_fisheye.or(shared.is_fisheye),
            w: own.w.or(shared.w),
            h: own.h.or(shared.h),
            fl_x: own.fl_x.or(shared.fl_x),
            fl_y: own.fl_y.or(shared.fl_y),
            cx: own.cx.or(shared.cx),
            cy: own.cy.or(shared.cy),
            camera_angle_x: own.camera_angle_x.or(shared.camera_angle_x),
            camera_angle_y: own.camera_angle_y.or(shared.camera_angle_y),
            k1: own.k1.or(shared.k1),
            k2: own.k2.or(shared.k2),
            k3: own.k3.or(shared.k3),
            k4: own.k4.or(shared.k4),
            p1: own.p1.or(shared.p1),
            p2: own.p2.or(shared.p2),
        }
    }

    fn refuse_distortion(&self) -> Result<(), Refusal> {
        const REMEDY: &str = "undistort the pictures first: run `colmap image_undistorter` on the COLMAP model that this file was made from, and open its output";
        let model = self.camera_model.as_deref().unwrap_or("PINHOLE");
        // An OPENCV camera without distortion is a pinhole camera. nerfstudio writes its pinhole
        // cameras as OPENCV.
        if self.is_fisheye == Some(true) || !matches!(model, "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV") {
            let model = if self.is_fisheye == Some(true) { "fisheye" } else { model };
            return Err(
                format!("the camera model {} is not supported; {REMEDY}", model.escape_debug()).into()
            );
        }
        let coefficients = [
            ("k1", self.k1),
            ("k2", self.k2),
            ("k3", self.k3),
            ("k4", self.k4),
            ("p1", self.p1),
            ("p2", self.p2),
        ];
        match coefficients.iter().find(|(_, value)| value.is_some_and(|value| value != 0.0)) {
            Some((name, _)) => Err(format!("the lens distortion {name} is not 0; {REMEDY}").into()),
            None => Ok(()),
        }
    }

    fn camera(&self, cam_from_world: Pose, picture: &Path) -> Result<Camera, Refusal> {
        let size_px = self.size_px(picture)?;
        let [width, height] = size_px.map(f64::from);
        let from_angle = |angle: f64, side: f64| 0.5 * side / (0.5 * angle).tan();
        let by_angle_x = self.camera_angle_x.map(|angle| from_angle(angle, width));
        let by_angle_y = self.camera_angle_y.map(|angle| from_angle(angle, height));
        let fl_x = self.fl_x.or(by_angle_x).ok_or("neither fl_x nor camera_angle_x is given")?;
        let fl_y = self.fl_y.or(by_angle_y).unwrap_or(fl_x);
        let focal_px = DVec2::new(fl_x, fl_y);
        let center_px = DVec2::new(self.cx.unwrap_or(0.5 * width), self.cy.unwrap_or(0.5 * height));
        if !(focal_px.min_element() > 0.0 && focal_px.is_finite() && center_px.is_finite()) {
            return Err(format!("the focal length {focal_px} px or centre {center_px} px is invalid").into());
        }
        Ok(Camera { cam_from_world, focal_px, center_px, size_px })
    }

    /// The picture's size from `w` and `h`, or from the picture's own header if one of them is
    /// missing.
    fn size_px(&self, picture: &Path) -> Result<[u32; 2], Refusal> {
        let (Some(w), Some(h)) = (self.w, self.h) else {
            return Picture::size_of(picture)
                .map_err(|error| format!("w and h are not given, and {error}").into());
        };
        let whole = |side: f64| (1.0..1e6).contains(&side) && side.fract() == 0.0;
        if !(whole(w) && whole(h)) {
            return Err(format!("the picture size {w} × {h} pixels is invalid").into());
        }
        Ok([w as u32, h as u32])
    }
}

#[cfg(test)]
mod tests;
