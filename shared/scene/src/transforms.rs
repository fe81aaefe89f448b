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
use crate::lens::{Distortion, Lens};
use crate::rotation::is_rotation;
use crate::shot::{Shot, find_picture};
use crate::sieve::Sieve;
use crate::{Picture, Pose, SceneError, View, mask_files, ply};

/// Longest accepted file, bytes; 10,000 frames take about 10 MB.
const FILE_BYTES_MAX: u64 = 1 << 28;

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
    // Coefficients of lens distortion.
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

/// Reads the file at `path`, and its points into `sieve`. Views keep the file's order. The pictures may be missing, unless
/// the file omits their sizes. Lenses must not be distorted.
pub(crate) fn read(path: &Path, sieve: &mut Sieve) -> Result<Vec<View>, SceneError> {
    let transforms = parse(path).map_err(|refusal| refusal.of(path))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let view = |frame: &Frame| {
        let shot = shot_of(folder, &transforms.shared, frame).map_err(|refusal| refusal.of(path))?;
        let view = shot.into_view(path)?;
        let mask = frame.mask_path.as_ref().map(|mask| mask_files::named(folder.join(mask)));
        // Results are called as the file calls the pictures, which may be without an extension.
        Ok(View { name: frame.file_path.clone(), mask, ..view })
    };
    let views = transforms.frames.iter().map(view).collect::<Result<_, SceneError>>()?;
    if let Some(cloud) = &transforms.ply_file_path {
        ply::read_points_into(sieve, &folder.join(cloud))?;
    }
    Ok(views)
}

/// The frames of the file at `path`, whose lenses may be distorted.
pub(crate) fn shots(path: &Path) -> Result<Vec<Shot>, SceneError> {
    let transforms = parse(path).map_err(|refusal| refusal.of(path))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let shot = |frame| shot_of(folder, &transforms.shared, frame).map_err(|refusal| refusal.of(path));
    transforms.frames.iter().map(shot).collect()
}

fn parse(path: &Path) -> Result<Transforms, Refusal> {
    let file = File::open(path)?;
    if file.metadata()?.len() > FILE_BYTES_MAX {
        return Err("is longer than 256 MiB, too long for a transforms.json".into());
    }
    serde_json::from_reader(BufReader::new(file))
        .map_err(|error| format!("is not a valid transforms.json: {error}").into())
}

fn shot_of(folder: &Path, shared: &Intrinsics, frame: &Frame) -> Result<Shot, Refusal> {
    let (name, path) = find_picture(folder, frame.file_path.trim_start_matches("./"));
    let placed = || {
        let lens = frame.own.over(shared).lens(&path)?;
        Ok((pose(&frame.transform_matrix)?, lens))
    };
    let (cam_from_world, lens) = placed()
        .map_err(|refusal: Refusal| refusal.at(format_args!("frame {}", frame.file_path.escape_debug())))?;
    Ok(Shot { name, path, cam_from_world, lens })
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
    let center = column(3);
    if !(is_rotation(&world_from_cam) && center.is_finite()) {
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

    fn distortion(&self) -> Result<Distortion, Refusal> {
        let [k1, k2, k3, k4, p1, p2] =
            [self.k1, self.k2, self.k3, self.k4, self.p1, self.p2].map(|value| value.unwrap_or(0.0));
        let model = match self.is_fisheye {
            Some(true) => "OPENCV_FISHEYE",
            _ => self.camera_model.as_deref().unwrap_or("PINHOLE"),
        };
        // nerfstudio writes its pinhole cameras as OPENCV, and some tools coefficients to PINHOLE.
        match model {
            "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" if k4 == 0.0 => {
                Ok(Distortion::Brown { radial: [k1, k2, k3], tangential: [p1, p2] })
            }
            "OPENCV_FISHEYE" if [p1, p2] == [0.0; 2] => Ok(Distortion::Fisheye([k1, k2, k3, k4])),
            "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" => Err("the lens distortion k4 is not supported".into()),
            "OPENCV_FISHEYE" => Err("the lens distortions p1 and p2 of a fisheye are not supported".into()),
            other => Err(format!(
                "the camera model {} is not supported; export an OPENCV or OPENCV_FISHEYE camera",
                other.escape_debug()
            )
            .into()),
        }
    }

    fn lens(&self, picture: &Path) -> Result<Lens, Refusal> {
        let size_px = self.size_px(picture)?;
        let [width, height] = size_px.map(f64::from);
        let from_angle = |angle: f64, side: f64| 0.5 * side / libm::tan(0.5 * angle);
        let by_angle_x = self.camera_angle_x.map(|angle| from_angle(angle, width));
        let by_angle_y = self.camera_angle_y.map(|angle| from_angle(angle, height));
        let fl_x = self.fl_x.or(by_angle_x).ok_or("neither fl_x nor camera_angle_x is given")?;
        let fl_y = self.fl_y.or(by_angle_y).unwrap_or(fl_x);
        let center_px = DVec2::new(self.cx.unwrap_or(0.5 * width), self.cy.unwrap_or(0.5 * height));
        let distortion = self.distortion()?;
        Lens { focal_px: DVec2::new(fl_x, fl_y), center_px, size_px, distortion }.checked()
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
