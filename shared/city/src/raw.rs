//! The city as a drone's memory card has it: photographs with EXIF through a distorting lens, and a list of the targets that
//! surveyors measured and marked. The truth lies beside them, so that everything made of the photographs can be measured.

use std::fmt::Write;
use std::path::Path;

use cosurf_geo::{GeoError, Geodetic, Georeference, SiteFrame};
use cosurf_scene::{Camera, Dataset, SceneError, atomic, colmap, files};
use glam::{DVec2, DVec3};

use super::city::City;
use super::exif::exif;
use super::optics::{Lens, Optics};
use super::random::Rng;
use super::sight::Sight;
use super::targets::Targets;
use super::write::{TRUTH, write_truth};

/// JPEG quality of photographs.
const QUALITY: u8 = 92;
/// Distortion of the lens, as that of a small drone: 3 % at the corners.
const LENS: Lens = Lens { radial: [-0.06, 0.012] };
/// Focal length that EXIF tells, mm.
const FOCAL_MM: f64 = 8.8;
/// Least and greatest factor on the light of a photograph: the camera chooses the exposure of each.
const EXPOSURES: [f32; 2] = [0.8, 1.25];
/// Standard deviation of a mark on a target, px along each axis.
const MARK_PX: f64 = 0.3;
/// A target is marked in at most this many photographs.
const MARKS_MAX: usize = 8;
/// Seconds between two photographs.
const SECONDS: u32 = 2;

/// How the photographs are taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawSettings {
    /// The place of the city's middle.
    pub origin: Geodetic,
    /// Standard deviation of GPS along each axis, metres, at least 0.
    pub gps_noise_m: f64,
    /// Length of the error that all of GPS has in common, metres, at least 0.
    pub gps_bias_m: f64,
    /// Number of targets on the ground.
    pub targets: usize,
}

impl Default for RawSettings {
    fn default() -> Self {
        let origin = Geodetic { latitude_deg: 52.5, longitude_deg: 13.4, height_m: 75.0 };
        Self { origin, gps_noise_m: 2.0, gps_bias_m: 3.0, targets: 9 }
    }
}

/// Why the photographs cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RawError {
    /// The origin is no place, or its system of maps is not known.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// A file cannot be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
}

impl City {
    /// Lays out targets, takes all photographs and writes them into `folder`, which is created: `DJI_*.JPG`,
    /// `gcp_list.txt` as ODM reads it, and in `gt` the poses (`sparse/0`), the surface and `geo.json` as they truly are.
    /// Calls `progress` with the number of photographs done and their total.
    pub fn write_raw(
        &self,
        settings: &RawSettings,
        folder: &Path,
        mut progress: impl FnMut(usize, usize),
    ) -> Result<(), RawError> {
        let truth = folder.join(TRUTH);
        files::create_folder(&truth)?;
        let georeference = Georeference::at(settings.origin)?;
        let site = georeference.site()?;
        let seed = self.settings().seed;
        let half_m = (0.5 * self.settings().extent_m) as f32;
        let targets = Targets::lay_out(&self.world.bvh, self.cameras(), half_m, settings.targets, seed);
        let mut rng = Rng::new(seed, 12);
        let bias_m = settings.gps_bias_m * direction(&mut rng);
        let mut dataset = self.dataset();
        let total = dataset.views.len();
        for (i, view) in dataset.views.iter_mut().enumerate() {
            view.name = format!("DJI_{:04}.JPG", i + 1);
            view.path = folder.join(&view.name);
            let optics = Optics { lens: LENS, gain: rng.range(EXPOSURES[0], EXPOSURES[1]) };
            let picture = self.world.render(&view.camera, &optics, &targets).picture;
            let noise_m = settings.gps_noise_m * DVec3::new(rng.normal(), rng.normal(), rng.normal());
            let place = site.geodetic_from_enu(view.camera.cam_from_world.center() + bias_m + noise_m);
            let exif = exif(&place, FOCAL_MM, SECONDS * i as u32)
                .map_err(|cause| SceneError::io(&view.path, cause))?;
            picture.write_photograph(&view.path, QUALITY, exif)?;
            progress(i + 1, total);
        }
        let list = self.control_points(&targets, &dataset, &georeference, &site, &mut rng)?;
        atomic::write_bytes(&folder.join("gcp_list.txt"), list.as_bytes())?;
        colmap::write(&truth, &dataset)?;
        write_truth(self, &truth)?;
        Ok(atomic::write_bytes(&truth.join(Georeference::FILE), georeference.to_json().as_bytes())?)
    }

    /// The targets with their marks, in ODM's format.
    fn control_points(
        &self,
        targets: &Targets,
        dataset: &Dataset,
        georeference: &Georeference,
        site: &SiteFrame,
        rng: &mut Rng,
    ) -> Result<String, GeoError> {
        let projection = georeference.projection()?;
        let sight = Sight::new(&self.world.bvh, self.cameras());
        let mut list = format!("EPSG:{}\n", projection.epsg());
        for (number, target) in targets.0.iter().enumerate() {
            let at = projection.project(&site.geodetic_from_enu(*target))?;
            let seeing = (0..dataset.views.len()).filter(|i| sight.sees(*i, *target));
            let marks = seeing.filter_map(|i| Some((i, mark(&dataset.views[i].camera, *target, rng)?)));
            for (i, mark_px) in marks.take(MARKS_MAX) {
                let name = &dataset.views[i].name;
                let DVec3 { x, y, z } = at;
                let _ = writeln!(
                    list,
                    "{x:.3} {y:.3} {z:.3} {:.2} {:.2} {name} target-{}",
                    mark_px.x,
                    mark_px.y,
                    number + 1
                );
            }
        }
        Ok(list)
    }
}

/// Where somebody marks a target in a photograph, px; `None` if the lens shows it outside.
fn mark(camera: &Camera, target: DVec3, rng: &mut Rng) -> Option<DVec2> {
    let seen_px = LENS.distorted(camera, camera.project(target)?);
    let mark_px = seen_px + MARK_PX * DVec2::new(rng.normal(), rng.normal());
    camera.contains(mark_px).then_some(mark_px)
}

/// A direction, each as likely as any other.
fn direction(rng: &mut Rng) -> DVec3 {
    DVec3::new(rng.normal(), rng.normal(), rng.normal()).normalize_or(DVec3::X)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_geo::{Gps, PhotoInfo};
    use cosurf_scene::Picture;

    use super::*;
    use crate::CitySettings;

    const SETTINGS: CitySettings = CitySettings { seed: 5, extent_m: 80.0, views: 20, size_px: [240, 180] };

    /// The place that a photograph's EXIF tells.
    fn told(path: &Path) -> Geodetic {
        let Gps { latitude_deg, longitude_deg, height_m, .. } = PhotoInfo::read(path).unwrap().gps.unwrap();
        Geodetic { latitude_deg, longitude_deg, height_m: height_m.unwrap() }
    }

    #[test]
    fn photographs_tell_where_they_were_taken_and_show_the_targets_where_they_are_marked() {
        let folder = tempfile::tempdir().unwrap();
        let (city, settings) = (City::build(&SETTINGS).unwrap(), RawSettings::default());
        let mut done = Vec::new();
        city.write_raw(&settings, folder.path(), |i, of| done.push((i, of))).unwrap();
        assert_eq!(done.last(), Some(&(20, 20)));
        let truth = Dataset::open(&folder.path().join("gt")).unwrap_err().to_string();
        assert!(truth.contains("DJI_0001.JPG"), "the truth has poses, but no pictures of its own: {truth}");
        let site = SiteFrame::new(settings.origin).unwrap();
        let errors: Vec<DVec3> = (city.cameras().iter().enumerate())
            .map(|(i, camera)| {
                let place = told(&folder.path().join(format!("DJI_{:04}.JPG", i + 1)));
                site.enu_from_geodetic(&place) - camera.cam_from_world.center()
            })
            .collect();
        let bias_m = errors.iter().sum::<DVec3>() / 20.0;
        assert!((1.5..4.5).contains(&bias_m.length()), "{bias_m}");
        let spread_m = errors.iter().map(|error| error.distance_squared(bias_m)).sum::<f64>() / 60.0;
        assert!((1.4..2.6).contains(&spread_m.sqrt()), "{spread_m}");

        let list = std::fs::read_to_string(folder.path().join("gcp_list.txt")).unwrap();
        let mut lines = list.lines();
        assert_eq!(lines.next(), Some("EPSG:32633"));
        let projection = Georeference::at(settings.origin).unwrap().projection().unwrap();
        let (mut names, mut clear, mut marks) = (std::collections::BTreeSet::new(), 0, 0);
        for line in lines {
            let words: Vec<&str> = line.split(' ').collect();
            let [x, y, z, u, v] = [0, 1, 2, 3, 4].map(|i| words[i].parse::<f64>().unwrap());
            let target = site.enu_from_geodetic(&projection.unproject(DVec3::new(x, y, z)).unwrap());
            let number: usize = words[5][4..8].parse().unwrap();
            let camera = &city.cameras()[number - 1];
            let seen_px = LENS.distorted(camera, camera.project(target).unwrap());
            assert!(seen_px.distance(DVec2::new(u, v)) < 5.0 * MARK_PX, "{line}: {seen_px}");
            let picture = Picture::read(&folder.path().join(words[5])).unwrap();
            clear += usize::from(is_chequered(&picture, [u, v]));
            marks += 1;
            names.insert(words[6].to_owned());
        }
        assert!(names.len() >= 6 && marks > 4 * names.len(), "{names:?}, {marks} marks");
        assert!(2 * clear > marks, "{clear} of {marks} marks show a target");
    }

    /// Whether there is something very dark and something very bright within 3 px.
    fn is_chequered(picture: &Picture, at_px: [f64; 2]) -> bool {
        let [width, height] = picture.size_px.map(|side| side as i64);
        let near = |at: f64, side: i64| (at as i64 - 3).max(0)..(at as i64 + 4).min(side);
        let grey = |x: i64, y: i64| {
            let at = 3 * (y * width + x) as usize;
            picture.rgb[at..at + 3].iter().map(|value| u32::from(*value)).sum::<u32>() / 3
        };
        let rows = near(at_px[1], height);
        let greys: Vec<u32> = rows.flat_map(|y| near(at_px[0], width).map(move |x| grey(x, y))).collect();
        greys.iter().min().unwrap() + 90 < *greys.iter().max().unwrap()
    }
}
