//! COLMAP's reconstructions before undistortion, in its text form: which photographs have poses, and the lenses.

mod lens;

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;

use cosurf_scene::{Pose, SceneError};
use glam::{DQuat, DVec2, DVec3};

use super::error::IngestError;
use lens::Lens;

/// A photograph with its pose.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Posed {
    pub(super) name: String,
    pub(super) cam_from_world: Pose,
    lens: u32,
}

/// A reconstruction.
pub(super) struct Reconstruction {
    pub(super) posed: Vec<Posed>,
    lenses: HashMap<u32, Lens>,
}

impl Reconstruction {
    /// Reads `cameras.txt` and `images.txt` of a folder.
    pub(super) fn read(folder: &Path) -> Result<Self, IngestError> {
        let mut lenses = HashMap::new();
        each_line(&folder.join("cameras.txt"), |line| {
            if !line.is_empty() && !line.starts_with('#') {
                let (id, lens) = Lens::parse(line)?;
                lenses.insert(id, lens);
            }
            Some(())
        })?;
        let mut posed = Vec::new();
        let mut is_points = false;
        each_line(&folder.join("images.txt"), |line| {
            // Each photograph has two lines. The second, its points, may be empty.
            if is_points {
                is_points = false;
            } else if !line.is_empty() && !line.starts_with('#') {
                posed.push(parse(line)?);
                is_points = true;
            }
            Some(())
        })?;
        posed.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Self { posed, lenses })
    }

    /// The line of sight through a pixel of the stored photograph: the camera's position and a direction of unit length,
    /// and the focal length, pixels. `None` if the lens does not see there.
    pub(super) fn sight(&self, posed: &Posed, at_px: DVec2) -> Option<(DVec3, DVec3, f64)> {
        let lens = self.lenses.get(&posed.lens)?;
        let ray = lens.ray(at_px)?.extend(1.0).normalize();
        let pose = &posed.cam_from_world;
        Some((pose.center(), pose.rotation.inverse() * ray, lens.focal_px.x))
    }
}

/// Reads a file line by line; `None` from `read` means that it is damaged.
fn each_line(path: &Path, mut read: impl FnMut(&str) -> Option<()>) -> Result<(), IngestError> {
    let failed = |cause| SceneError::io(path, cause);
    let file = BufReader::new(File::open(path).map_err(failed)?);
    for (number, line) in (1..).zip(file.lines()) {
        let line: String = line.map_err(failed)?;
        if read(line.trim()).is_none() {
            let reason = format!("line {number} is not as COLMAP writes it; remove the folder and run again");
            return Err(SceneError::malformed(path, reason).into());
        }
    }
    Ok(())
}

/// `id qw qx qy qz tx ty tz camera name`. The name may have spaces.
fn parse(line: &str) -> Option<Posed> {
    let mut words = line.splitn(10, ' ');
    let _id = words.next()?;
    let mut numbers = [0.0; 7];
    for number in &mut numbers {
        *number = words.next()?.parse().ok().filter(|number: &f64| number.is_finite())?;
    }
    let [w, x, y, z, ..] = numbers;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let translation = DVec3::new(numbers[4], numbers[5], numbers[6]);
    let lens = words.next()?.parse().ok()?;
    let name = words.next()?.to_owned();
    let cam_from_world = Pose { rotation: rotation.normalize(), translation };
    (rotation.length() > 1e-6).then_some(Posed { name, cam_from_world, lens })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn photographs_without_points_and_names_with_spaces_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        write("cameras.txt", "# Camera list\n3 OPENCV 640 480 500 500 320 240 0 0 0 0\n");
        write(
            "images.txt",
            "# Image list\n7 1 0 0 0 0 0 2 3 b ü.JPG\n\n1 0 1 0 0 0 0 2 3 100MEDIA/a.jpg\n1.5 2.5 -1\n",
        );
        let found = Reconstruction::read(folder.path()).unwrap();
        let names: Vec<&str> = found.posed.iter().map(|posed| &*posed.name).collect();
        assert_eq!(names, ["100MEDIA/a.jpg", "b ü.JPG"]);
        let (eye, ray, focal_px) = found.sight(&found.posed[1], DVec2::new(320.0, 240.0)).unwrap();
        assert_eq!((eye, ray, focal_px), (DVec3::new(0.0, 0.0, -2.0), DVec3::Z, 500.0));
        write("images.txt", "7 1 0 0 0 0 0 x 3 b.JPG\n");
        let error = Reconstruction::read(folder.path()).err().unwrap().to_string();
        assert!(error.contains("images.txt: line 1"), "{error}");
    }
}
