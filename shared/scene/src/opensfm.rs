//! Reads the `reconstruction.json` of OpenSfM and of OpenDroneMap, which contains it
//! (opensfm.org/docs/dataset.html#reconstruction-file-format, and `docs/geometry.html` for the cameras).
//!
//! The file is a list of reconstructions; that with most pictures is read. Cameras must have no distortion, as those that
//! `opensfm undistort` writes. Lengths of a camera are in units of the picture's longer side, from its middle. The axes of
//! cameras are those of [`crate::camera`]; rotations are axes of which the length is the angle, radians.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec2, DVec3};
use serde::Deserialize;

use crate::error::Refusal;
use crate::sieve::Sieve;
use crate::{Camera, Pose, SceneError, SparsePoint, View, files};

/// Name of the file in a project's folder.
pub(crate) const FILE: &str = "reconstruction.json";
/// Longest accepted file, bytes; a million points take about 150 MB.
const FILE_BYTES_MAX: u64 = 1 << 30;
/// Largest accepted width or height, pixels.
const SIDE_PX_MAX: u32 = 1 << 20;

#[derive(Deserialize)]
struct Reconstruction {
    cameras: BTreeMap<String, Lens>,
    shots: BTreeMap<String, Shot>,
    #[serde(default)]
    points: BTreeMap<String, Point>,
}

#[derive(Deserialize)]
struct Lens {
    projection_type: String,
    width: u32,
    height: u32,
    /// Of `perspective` and `simple_radial`.
    focal: Option<f64>,
    /// Of `brown` and others.
    focal_x: Option<f64>,
    focal_y: Option<f64>,
    #[serde(default)]
    c_x: f64,
    #[serde(default)]
    c_y: f64,
    #[serde(default)]
    k1: f64,
    #[serde(default)]
    k2: f64,
    #[serde(default)]
    k3: f64,
    #[serde(default)]
    p1: f64,
    #[serde(default)]
    p2: f64,
}

#[derive(Deserialize)]
struct Shot {
    camera: String,
    rotation: [f64; 3],
    translation: [f64; 3],
}

#[derive(Deserialize)]
struct Point {
    coordinates: [f64; 3],
    #[serde(default)]
    color: [f64; 3],
}

/// Reads the file `path`, and its points into `sieve`. The pictures are in `images` beside it, or beside it; they may be
/// missing.
pub(crate) fn read(path: &Path, sieve: &mut Sieve) -> Result<Vec<View>, SceneError> {
    let its = parse(path).map_err(|refusal| refusal.of(path))?;
    let root = path.parent().unwrap_or(Path::new(""));
    let images = root.join("images");
    let folder = if images.is_dir() { images } else { root.to_owned() };
    let view = |(name, shot): (&String, &Shot)| {
        let camera =
            camera(&its, shot).map_err(|refusal| refusal.at(format_args!("shot {}", name.escape_debug())))?;
        let path: PathBuf = files::in_any_case(folder.join(name));
        Ok(View { name: name.clone(), camera, path, mask: None })
    };
    let views = its.shots.iter().map(view).collect::<Result<_, Refusal>>();
    let views = views.map_err(|refusal| refusal.of(path))?;
    for (id, point) in &its.points {
        let position = DVec3::from(point.coordinates);
        if !position.is_finite() {
            return Err(SceneError::malformed(path, format!("point {} is not finite", id.escape_debug())));
        }
        sieve.add(SparsePoint { position, rgb: point.color.map(|value| value as u8), views: Vec::new() });
    }
    Ok(views)
}

/// The reconstruction with most pictures.
fn parse(path: &Path) -> Result<Reconstruction, Refusal> {
    let file = File::open(path)?;
    if file.metadata()?.len() > FILE_BYTES_MAX {
        return Err("is longer than 1 GiB, too long for a reconstruction.json".into());
    }
    let all: Vec<Reconstruction> = serde_json::from_reader(BufReader::new(file))
        .map_err(|error| Refusal::from(format!("is not a valid reconstruction.json of OpenSfM: {error}")))?;
    let largest = all.into_iter().max_by_key(|one| one.shots.len());
    largest.ok_or_else(|| "has no reconstruction; run OpenSfM again".into())
}

fn camera(its: &Reconstruction, shot: &Shot) -> Result<Camera, Refusal> {
    let unknown = || format!("refers to the unknown camera '{}'", shot.camera.escape_debug());
    let lens = its.cameras.get(&shot.camera).ok_or_else(unknown)?;
    lens.refuse_distortion()?;
    let turn = DVec3::from(shot.rotation);
    let translation = DVec3::from(shot.translation);
    if !(turn.is_finite() && translation.is_finite()) {
        return Err("its pose is not finite".into());
    }
    let size_px = [lens.width, lens.height];
    if size_px.iter().any(|side| !(1..=SIDE_PX_MAX).contains(side)) {
        return Err(format!("the picture size {} × {} pixels is invalid", lens.width, lens.height).into());
    }
    let unit_px = f64::from(lens.width.max(lens.height));
    let focal = DVec2::new(
        lens.focal.or(lens.focal_x).ok_or("its camera has neither focal nor focal_x")?,
        lens.focal.or(lens.focal_y).or(lens.focal_x).unwrap_or(0.0),
    );
    let (focal_px, middle) = (focal * unit_px, 0.5 * DVec2::from(size_px.map(f64::from)));
    let center_px = middle + DVec2::new(lens.c_x, lens.c_y) * unit_px;
    if !(focal_px.min_element() > 0.0 && focal_px.is_finite() && center_px.is_finite()) {
        return Err(format!("the focal length {focal_px} px or centre {center_px} px is invalid").into());
    }
    let rotation = DQuat::from_scaled_axis(turn);
    Ok(Camera { cam_from_world: Pose { rotation, translation }, focal_px, center_px, size_px })
}

impl Lens {
    fn refuse_distortion(&self) -> Result<(), Refusal> {
        const REMEDY: &str = "run `opensfm undistort PROJECT`, and give PROJECT/undistorted";
        let kind = self.projection_type.as_str();
        if !matches!(kind, "perspective" | "simple_radial" | "radial" | "brown") {
            return Err(format!("the projection {} is not supported; {REMEDY}", kind.escape_debug()).into());
        }
        match [self.k1, self.k2, self.k3, self.p1, self.p2] == [0.0; 5] {
            true => Ok(()),
            false => Err(format!("its lens is distorted; {REMEDY}").into()),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::f64::consts::FRAC_PI_2;
    use std::fs;

    use super::*;
    use crate::{Dataset, Picture};

    /// A project in the layout of the documentation, with two reconstructions, of which the second has two pictures.
    fn project(k1: f64) -> String {
        let shot = |x: f64| {
            format!(
                r#"{{"camera": "v2 dji", "rotation": [{FRAC_PI_2}, 0, 0], "translation": [{x}, 1, 2], "orientation": 1, "gps_dop": 5.0}}"#
            )
        };
        format!(
            r#"[{{"cameras": {{}}, "shots": {{}}}}, {{
            "cameras": {{"v2 dji": {{"projection_type": "brown", "width": 8, "height": 6, "focal_x": 1.0, "focal_y": 1.25,
            "c_x": 0.125, "c_y": 0.0, "k1": {k1}, "k2": 0, "p1": 0, "p2": 0, "k3": 0}}}},
            "shots": {{"b.JPG": {}, "a.JPG": {}}},
            "points": {{"7": {{"color": [1.0, 2.0, 255.0], "coordinates": [0.5, 1.5, -2.0]}}}}}}]"#,
            shot(0.0),
            shot(-3.0)
        )
    }

    #[test]
    fn cameras_and_points_are_those_of_the_documentation() {
        let root = tempfile::tempdir().unwrap();
        fs::write(root.path().join(FILE), project(0.0)).unwrap();
        fs::create_dir(root.path().join("images")).unwrap();
        for name in ["a.jpg", "b.JPG"] {
            let path = root.path().join("images").join(name);
            Picture::new([8, 6], vec![9; 144]).write_jpeg(&path, 90).unwrap();
        }
        let dataset = Dataset::open(root.path()).unwrap();
        let names: Vec<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
        assert_eq!(names, ["a.JPG", "b.JPG"]);
        let camera = dataset.views[1].camera;
        assert_eq!((camera.focal_px, camera.center_px), (DVec2::new(8.0, 10.0), DVec2::new(5.0, 3.0)));
        // A turn by 90° about x takes the world's y to z, and a point 4 along y to 4 + 2 before the camera.
        let (at_px, depth) = camera.project_with_depth(DVec3::new(0.0, 4.0, 0.0)).unwrap();
        assert!(
            (depth - 6.0).abs() < 1e-12 && (at_px.y - (3.0 + 10.0 / 6.0)).abs() < 1e-12,
            "{at_px} {depth}"
        );
        assert_eq!(
            (dataset.points[0].rgb, dataset.points[0].position),
            ([1, 2, 255], DVec3::new(0.5, 1.5, -2.0))
        );
    }

    #[test]
    fn files_that_cannot_be_used_are_told_in_a_line() {
        let root = tempfile::tempdir().unwrap();
        let complaint = |text: &str| {
            fs::write(root.path().join(FILE), text).unwrap();
            let error = Dataset::cameras(root.path()).unwrap_err().to_string();
            assert!(error.contains(FILE) && error.lines().count() == 1, "{error}");
            error
        };
        assert!(complaint(&project(0.1)).contains("opensfm undistort"));
        assert!(complaint(&project(0.0).replace("brown", "fisheye")).contains("fisheye"));
        assert!(
            complaint(&project(0.0).replace(r#""camera": "v2 dji""#, r#""camera": "v3""#))
                .contains("unknown camera 'v3'")
        );
        assert!(complaint(&project(0.0).replace(r#""width": 8"#, r#""width": 0"#)).contains("0 × 6"));
        assert!(
            complaint(&project(0.0).replace(r#""focal_x": 1.0"#, r#""focal_x": -1.0"#))
                .contains("focal length")
        );
        assert!(complaint("[]").contains("no reconstruction"));
        assert!(complaint(&project(0.0)[..200]).contains("not a valid"));
    }
}
