//! Writes models in the binary form.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use glam::DVec2;

use crate::lens::Distortion;
use crate::{Camera, Dataset, Pose, SceneError, Shot, View, atomic, files};

/// COLMAP's numbers for camera models (`src/colmap/sensor/models.h`).
const PINHOLE: u32 = 1;
const OPENCV_FISHEYE: u32 = 5;
const FULL_OPENCV: u32 = 6;

/// Writes cameras, poses and points as a binary model into `root/sparse/0`, which is created. Views
/// with the same intrinsics share a COLMAP camera. The 2D points of a picture are the projections
/// of the 3D points whose tracks name the picture; (0, 0) for a point that is not in front of the
/// camera. Pictures are not copied: they belong at `root/images/NAME`.
pub fn write(root: &Path, dataset: &Dataset) -> Result<(), SceneError> {
    let model = root.join("sparse").join("0");
    files::create_folder(&model)?;
    let cameras = Cameras::of(&dataset.views);
    let tracks = Tracks::of(dataset);
    atomic::write(&model.join("cameras.bin"), |out| cameras.write(out))?;
    atomic::write(&model.join("images.bin"), |out| write_images(out, dataset, &cameras, &tracks))?;
    atomic::write(&model.join("points3D.bin"), |out| write_points(out, dataset, &tracks))
}

/// Writes shots as a binary model without points into a folder, which is created, for COLMAP's undistorter. Each shot has a
/// camera of its own. Errors: a lens that COLMAP does not know.
pub fn write_shots(model: &Path, shots: &[Shot]) -> Result<(), SceneError> {
    files::create_folder(model)?;
    atomic::write(&model.join("cameras.bin"), |out| write_lenses(out, shots))?;
    atomic::write(&model.join("images.bin"), |out| write_unmarked(out, shots))?;
    atomic::write(&model.join("points3D.bin"), |out| out.write_all(&0_u64.to_le_bytes()))
}

fn write_lenses(out: &mut Out, shots: &[Shot]) -> io::Result<()> {
    out.write_all(&(shots.len() as u64).to_le_bytes())?;
    for (id, Shot { lens, .. }) in (1_u32..).zip(shots) {
        let pinhole = [lens.focal_px.to_array(), lens.center_px.to_array()].concat();
        let (model, coefficients) = match lens.distortion {
            // Of another model without distortion, COLMAP copies the picture, but gives it a camera of another size.
            Distortion::NONE => (PINHOLE, Vec::new()),
            Distortion::Fisheye(k) => (OPENCV_FISHEYE, k.to_vec()),
            Distortion::Brown { radial: [k1, k2, k3], tangential: [p1, p2] } => {
                (FULL_OPENCV, vec![k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])
            }
            Distortion::FullBrown(_) => return Err(io::Error::other("COLMAP does not know this lens")),
        };
        put_u32s(out, &[id, model])?;
        for side in lens.size_px {
            out.write_all(&u64::from(side).to_le_bytes())?;
        }
        put_f64s(out, &[pinhole, coefficients].concat())?;
    }
    Ok(())
}

fn write_unmarked(out: &mut Out, shots: &[Shot]) -> io::Result<()> {
    out.write_all(&(shots.len() as u64).to_le_bytes())?;
    for (id, shot) in (1_u32..).zip(shots) {
        put_u32s(out, &[id])?;
        put_pose(out, &shot.cam_from_world)?;
        put_u32s(out, &[id])?;
        out.write_all(shot.name.as_bytes())?;
        out.write_all(&[0])?;
        out.write_all(&0_u64.to_le_bytes())?;
    }
    Ok(())
}

/// The distinct intrinsics of the views. Each is written once, as a COLMAP camera.
struct Cameras<'a> {
    distinct: Vec<&'a Camera>,
    /// For each view, the index of its intrinsics in `distinct`.
    of_view: Vec<u32>,
}

impl<'a> Cameras<'a> {
    fn of(views: &'a [View]) -> Self {
        let mut distinct: Vec<&Camera> = Vec::new();
        let same = |a: &Camera, b: &Camera| {
            (a.focal_px, a.center_px, a.size_px) == (b.focal_px, b.center_px, b.size_px)
        };
        let of_view = views.iter().map(|View { camera, .. }| {
            // The search begins at the end, because a view mostly has the camera of the view before
            // it.
            let found = distinct.iter().rposition(|other| same(other, camera));
            found.unwrap_or_else(|| {
                distinct.push(camera);
                distinct.len() - 1
            }) as u32
        });
        let of_view = of_view.collect();
        Self { distinct, of_view }
    }

    fn write(&self, out: &mut Out) -> io::Result<()> {
        out.write_all(&(self.distinct.len() as u64).to_le_bytes())?;
        for (id, camera) in (1_u32..).zip(&self.distinct) {
            put_u32s(out, &[id, PINHOLE])?;
            for side in camera.size_px {
                out.write_all(&u64::from(side).to_le_bytes())?;
            }
            put_f64s(out, &[camera.focal_px.to_array(), camera.center_px.to_array()].concat())?;
        }
        Ok(())
    }
}

/// Which views see which points, indexed both ways.
struct Tracks {
    /// For each view, the indices of the points that it sees.
    points: Vec<Vec<u32>>,
    /// For each point and each view of its track: the position of the point in that view's list in
    /// `points`.
    places: Vec<Vec<u32>>,
}

impl Tracks {
    fn of(dataset: &Dataset) -> Self {
        let mut points = vec![Vec::new(); dataset.views.len()];
        let mut place = |point: usize, view: u32| {
            let seen = &mut points[view as usize];
            seen.push(point as u32);
            seen.len() as u32 - 1
        };
        let places = dataset.points.iter().enumerate();
        let places =
            places.map(|(i, point)| point.views.iter().map(|&view| place(i, view)).collect()).collect();
        Self { points, places }
    }
}

type Out = BufWriter<File>;

fn write_images(out: &mut Out, dataset: &Dataset, cameras: &Cameras, tracks: &Tracks) -> io::Result<()> {
    out.write_all(&(dataset.views.len() as u64).to_le_bytes())?;
    for (i, View { name, camera, .. }) in dataset.views.iter().enumerate() {
        put_u32s(out, &[i as u32 + 1])?;
        put_pose(out, &camera.cam_from_world)?;
        put_u32s(out, &[cameras.of_view[i] + 1])?;
        out.write_all(name.as_bytes())?;
        out.write_all(&[0])?;
        out.write_all(&(tracks.points[i].len() as u64).to_le_bytes())?;
        for &point in &tracks.points[i] {
            let at = camera.project(dataset.points[point as usize].position).unwrap_or(DVec2::ZERO);
            put_f64s(out, &at.to_array())?;
            out.write_all(&(u64::from(point) + 1).to_le_bytes())?;
        }
    }
    Ok(())
}

fn write_points(out: &mut Out, dataset: &Dataset, tracks: &Tracks) -> io::Result<()> {
    out.write_all(&(dataset.points.len() as u64).to_le_bytes())?;
    for (i, point) in dataset.points.iter().enumerate() {
        out.write_all(&(i as u64 + 1).to_le_bytes())?;
        put_f64s(out, &point.position.to_array())?;
        out.write_all(&point.rgb)?;
        put_f64s(out, &[0.0])?; // reprojection error: 0, because the 2D points are exact projections
        out.write_all(&(point.views.len() as u64).to_le_bytes())?;
        for (view, place) in point.views.iter().zip(&tracks.places[i]) {
            put_u32s(out, &[view + 1, *place])?;
        }
    }
    Ok(())
}

fn put_pose(out: &mut Out, pose: &Pose) -> io::Result<()> {
    put_f64s(out, &[pose.rotation.w, pose.rotation.x, pose.rotation.y, pose.rotation.z])?;
    put_f64s(out, &pose.translation.to_array())
}

fn put_u32s(out: &mut Out, values: &[u32]) -> io::Result<()> {
    values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
}

fn put_f64s(out: &mut Out, values: &[f64]) -> io::Result<()> {
    values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
}
