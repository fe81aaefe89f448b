//! Photographs whose poses another tool has found: they are only undistorted.
//!
//! What it knows nothing about: the formats of the other tools ([`cosurf_scene::Distorted`]).

use std::fs;
use std::path::{Path, PathBuf};

use cosurf_contract::{AgentEvent, IngestReport, IngestStage};
use cosurf_geo::{Geodetic, Georeference, SiteFrame};
use cosurf_scene::{Dataset, Distorted, Picture, Pose, SceneError, Shot, SparsePoint, View, colmap};
use glam::{DAffine3, DQuat};

use super::colmap::Colmap;
use super::photographs::reason;
use super::placing::round_median;
use super::stages::{Stage, Stages};
use super::{IngestError, straight};

/// The stage that undistorts, and where the dataset lies if the poses tell that.
pub(super) struct Given {
    images: PathBuf,
    model: PathBuf,
    /// Empty if COLMAP has the poses in its own files.
    shots: Vec<Shot>,
    key: blake3::Hash,
    points: Vec<SparsePoint>,
    pub(super) georeference: Option<Georeference>,
    /// Name and reason of what is not used.
    pub(super) left_out: Option<(String, String)>,
}

impl Given {
    /// Reads the poses in a folder, and writes them to `work` as COLMAP wants them. Of an earth-centred world, they are moved
    /// to the site about `origin`, or else about their median.
    pub(super) fn read(folder: &Path, work: &Path, origin: Option<Geodetic>) -> Result<Self, IngestError> {
        let absolute = |path: &Path| fs::canonicalize(path).map_err(|cause| SceneError::io(path, cause));
        let beside = Georeference::of_folder(folder)?;
        match Distorted::open(folder)? {
            Distorted::Colmap { model, images } => {
                let (model, images) = (absolute(&model)?, absolute(&images)?);
                let key = blake3::hash(b"colmap");
                let (shots, points) = (Vec::new(), Vec::new());
                Ok(Self { images, model, shots, key, points, georeference: beside, left_out: None })
            }
            Distorted::Shots { images, mut shots, is_geocentric, points, unused } => {
                let georeference = match is_geocentric {
                    true => Some(move_to_site(&mut shots, origin)?),
                    false => beside,
                };
                let model = absolute(work)?.join("given");
                let (images, key) = (absolute(&images)?, key_of(&shots)?);
                let left_out = unused.map(|(path, reason)| (path.display().to_string(), reason));
                Ok(Self { images, model, shots, key, points, georeference, left_out })
            }
        }
    }

    /// Undistorts and shrinks the pictures, and returns the dataset of them.
    pub(super) fn undistort(
        &self,
        colmap: &Colmap,
        work: &Path,
        max_size_px: u32,
        tell: &mut dyn FnMut(AgentEvent),
    ) -> Result<Dataset, IngestError> {
        let (images, shots) = straight::prepare(&self.shots, &self.images, work, &self.key, tell)?;
        if !shots.is_empty() {
            colmap::write_shots(&self.model, &shots)?;
        }
        let folder = work.join("undistorted");
        let options = [
            (&["image_path"][..], images.into()),
            (&["input_path"], (&self.model).into()),
            (&["output_path"], (&folder).into()),
            (&["output_type"], "COLMAP".into()),
            (&["max_image_size"], max_size_px.to_string().into()),
        ];
        let commands = vec![(colmap.command("image_undistorter", &options)?, shots.len())];
        let files =
            ["cameras.bin", "images.bin", "cameras.txt", "images.txt"].map(|name| self.model.join(name));
        let inputs = files.into_iter().filter(|file| file.is_file()).collect();
        let folders = vec![folder.clone()];
        let stage =
            Stage { kind: IngestStage::Undistorting, commands, inputs, removed: folders.clone(), folders };
        Stages::new(colmap, work, self.key, tell).run(&stage)?;
        let mut dataset = Dataset::open(&folder)?;
        dataset.points.extend_from_slice(&self.points);
        Ok(dataset)
    }

    /// The dataset without pictures whose photographs are damaged: COLMAP makes grey ones of them. Also returns the names of
    /// these photographs, and what is wrong.
    pub(super) fn without_damaged(&self, dataset: Dataset) -> (Dataset, Vec<(String, String)>) {
        let fault = |view: &View| {
            let photograph = self.images.join(&view.name);
            let error = photograph.is_file().then(|| Picture::size_of_whole(&photograph).err()).flatten()?;
            Some((view.name.clone(), reason(&error)))
        };
        let faults: Vec<Option<(String, String)>> = dataset.views.iter().map(fault).collect();
        let whole: Vec<usize> = (0..faults.len()).filter(|i| faults[*i].is_none()).collect();
        let dataset = if whole.len() < faults.len() { dataset.subset(&whole) } else { dataset };
        (dataset, faults.into_iter().flatten().collect())
    }

    /// What was made of it.
    pub(super) fn report(&self, dataset: &Dataset) -> IngestReport {
        let (posed, points) = (dataset.views.len(), dataset.points.len());
        let photographs = self.shots.len().max(posed);
        IngestReport { photographs, posed, points, georeferenced: self.georeference.is_some() }
    }
}

/// Hash of the pictures by their names, sizes, times of change, and lenses that COLMAP does not know.
fn key_of(shots: &[Shot]) -> Result<blake3::Hash, IngestError> {
    let mut hasher = blake3::Hasher::new();
    for Shot { name, path, lens, .. } in shots {
        let metadata = fs::metadata(path).map_err(|cause| SceneError::io(path, cause))?;
        hasher.update(format!("{name:?} {} {:?}\n", metadata.len(), metadata.modified().ok()).as_bytes());
        if !lens.is_known_to_colmap() {
            hasher.update(format!("{lens:?}\n").as_bytes());
        }
    }
    Ok(hasher.finalize())
}

/// Moves shots from the earth-centred frame to the frame of a site.
fn move_to_site(shots: &mut [Shot], origin: Option<Geodetic>) -> Result<Georeference, IngestError> {
    let places: Vec<Geodetic> =
        shots.iter().map(|shot| Geodetic::from_ecef(shot.cam_from_world.center())).collect();
    let site = SiteFrame::new(origin.unwrap_or_else(|| round_median(&places)))?;
    let ecef_from_enu: DAffine3 = site.ecef_from_enu();
    let turn = DQuat::from_mat3(&ecef_from_enu.matrix3);
    for (shot, place) in shots.iter_mut().zip(&places) {
        let rotation = (shot.cam_from_world.rotation * turn).normalize();
        shot.cam_from_world = Pose { rotation, translation: -(rotation * site.enu_from_geodetic(place)) };
    }
    Ok(Georeference::at(site.origin())?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Camera, Distortion, Lens};
    use glam::{DVec2, DVec3};

    use super::*;

    /// COLMAP undistorts what it can decode, and leaves the rest grey.
    #[test]
    fn photographs_that_were_cut_short_are_left_out_of_the_dataset() {
        let folder = tempfile::tempdir().unwrap();
        let view = |i: u8| {
            let path = folder.path().join(format!("{i}.jpg"));
            Picture::new([16, 16], vec![i; 768]).write_jpeg(&path, 90).unwrap();
            let camera = Camera {
                cam_from_world: Pose::look_at(DVec3::new(f64::from(i), 0.0, 9.0), DVec3::ZERO, DVec3::Y),
                focal_px: DVec2::splat(16.0),
                center_px: DVec2::splat(8.0),
                size_px: [16, 16],
            };
            View { name: format!("{i}.jpg"), path, camera, mask: None }
        };
        let dataset = Dataset { views: (0..4).map(view).collect(), points: Vec::new() };
        let cut = folder.path().join("2.jpg");
        let bytes = fs::read(&cut).unwrap();
        fs::write(&cut, &bytes[..bytes.len() - 2]).unwrap();
        let given = Given {
            images: folder.path().into(),
            model: folder.path().into(),
            shots: Vec::new(),
            key: blake3::hash(b""),
            georeference: None,
            points: Vec::new(),
            left_out: None,
        };
        let (dataset, left_out) = given.without_damaged(dataset);
        let names: Vec<&str> = dataset.views.iter().map(|view| &*view.name).collect();
        assert_eq!((names, &*left_out[0].0, left_out.len()), (vec!["0.jpg", "1.jpg", "3.jpg"], "2.jpg", 1));
        assert!(left_out[0].1.contains("cut short"), "{left_out:?}");
    }

    #[test]
    fn cameras_of_the_whole_earth_look_the_same_way_at_the_site() {
        let origin = Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 };
        let site = SiteFrame::new(origin).unwrap();
        let (eye, target) = (DVec3::new(30.0, -40.0, 60.0), DVec3::new(0.0, 10.0, 0.0));
        let ecef = |enu: DVec3| site.ecef_from_enu().transform_point3(enu);
        let up = ecef(DVec3::Z) - ecef(DVec3::ZERO);
        let lens = Lens {
            focal_px: DVec2::splat(9.0),
            center_px: DVec2::splat(4.0),
            size_px: [8; 2],
            distortion: Distortion::Fisheye([0.0; 4]),
        };
        let cam_from_world = Pose::look_at(ecef(eye), ecef(target), up);
        let mut shots = [Shot { name: "a".into(), path: "a".into(), cam_from_world, lens }];
        assert_eq!(move_to_site(&mut shots, Some(origin)).unwrap().origin, origin);
        let (is, wanted) = (shots[0].cam_from_world, Pose::look_at(eye, target, DVec3::Z));
        assert!(is.center().distance(eye) < 1e-6, "{}", is.center());
        assert!(is.rotation.dot(wanted.rotation).abs() > 1.0 - 1e-9, "{is:?} {wanted:?}");
    }
}
