//! The georeference that results take over from what they are made of: `geo.json` of a dataset or of models.
//!
//! What it knows nothing about: what is made of the folders.

use std::path::{Path, PathBuf};

use cosurf_geo::{GeoError, Georeference};
use cosurf_scene::{SceneError, atomic};

/// Why folders have no common georeference.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GeoreferenceError {
    /// A file cannot be read, or is wrong.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// Two folders have worlds about different origins.
    #[error("{} and {} have different origins in {}; make both about one origin (`cosurf-agent ingest --origin`), or leave one out", first.display(), second.display(), Georeference::FILE)]
    OtherOrigin {
        /// A folder.
        first: PathBuf,
        /// A folder whose world has another origin.
        second: PathBuf,
    },
}

/// The georeference that these folders have in common; `None` if none has one. All that have one must agree on the origin,
/// because their worlds are about it. If several tell how well their place is known, the result has what each of them tells.
pub fn common_georeference(folders: &[PathBuf]) -> Result<Option<Georeference>, GeoreferenceError> {
    let mut known: Vec<(&PathBuf, Georeference)> = Vec::new();
    for folder in folders {
        let Some(found) = Georeference::of_folder(folder)? else { continue };
        if let Some((first, _)) = known.first().filter(|(_, common)| common.origin != found.origin) {
            let (first, second) = ((*first).clone(), folder.clone());
            return Err(GeoreferenceError::OtherOrigin { first, second });
        }
        known.push((folder, found));
    }
    if known.len() < 2 {
        return Ok(known.pop().map(|(_, georeference)| georeference));
    }
    let take =
        |(folder, its): &mut (&PathBuf, Georeference)| its.take_residuals(&folder.display().to_string());
    let drones = known.iter_mut().flat_map(take).collect();
    Ok(known.into_iter().next().map(|(_, common)| Georeference { drones, ..common }))
}

/// Writes `geo.json` to a folder, atomically, if there is a georeference.
pub fn write_georeference(georeference: Option<&Georeference>, folder: &Path) -> Result<(), SceneError> {
    georeference.map_or(Ok(()), |known| {
        atomic::write_bytes(&folder.join(Georeference::FILE), known.to_json().as_bytes())
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_geo::{Geodetic, GpsResiduals, PointResidual, Residuals};

    use super::*;

    #[test]
    fn results_take_over_the_georeference_unless_origins_differ() {
        let folders: Vec<_> = (0..3).map(|_| tempfile::tempdir().unwrap()).collect();
        let paths: Vec<PathBuf> = folders.iter().map(|folder| folder.path().to_path_buf()).collect();
        assert_eq!(common_georeference(&paths).unwrap(), None);
        let origin = Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 };
        let here = Georeference::at(origin).unwrap();
        write_georeference(Some(&here), &paths[1]).unwrap();
        assert_eq!(common_georeference(&paths).unwrap(), Some(here));
        let there = Georeference::at(Geodetic { height_m: 71.0, ..origin }).unwrap();
        write_georeference(Some(&there), &paths[2]).unwrap();
        let error = common_georeference(&paths).unwrap_err().to_string();
        assert!(error.contains("different origins in geo.json"), "{error}");
    }

    #[test]
    fn a_merged_place_has_the_residuals_of_all_drones_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let origin = Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 };
        let gps = |horizontal_rms_m| GpsResiduals {
            photographs: 9,
            with_accuracy: 0,
            agreeing: 9,
            horizontal_rms_m,
            vertical_rms_m: 4.0,
        };
        let point = PointResidual { name: "A".into(), photographs: 3, residual_m: [0.01, -0.02, 0.05] };
        let bare = Georeference::at(origin).unwrap();
        let with = |rms_m, check: Vec<PointResidual>| Georeference {
            residuals: Residuals { gps: Some(gps(rms_m)), check, ..Residuals::default() },
            ..bare.clone()
        };
        let east = with(2.0, vec![point.clone()]);
        let places = [("east", east), ("west", with(3.0, Vec::new())), ("plan", bare.clone())];
        let folders = places.map(|(name, place)| {
            let path = folder.path().join(name);
            std::fs::create_dir(&path).unwrap();
            write_georeference(Some(&place), &path).unwrap();
            path
        });
        let merged = common_georeference(&folders).unwrap().unwrap();
        assert!(merged.residuals == Residuals::default(), "{merged:?}");
        let [east, west] = &merged.drones[..] else { panic!("{merged:?}") };
        let name = |path: &Path| path.display().to_string();
        assert_eq!((&east.name, &west.name), (&name(&folders[0]), &name(&folders[1])));
        assert_eq!((east.residuals.gps, &east.residuals.check), (Some(gps(2.0)), &vec![point]));
        assert_eq!(west.residuals.gps, Some(gps(3.0)));
        // A merge of merges keeps all of them.
        let site = folder.path().join("site");
        std::fs::create_dir(&site).unwrap();
        write_georeference(Some(&merged), &site).unwrap();
        let whole = common_georeference(&[site, folders[1].clone()]).unwrap().unwrap();
        assert_eq!(whole.drones.len(), 3);
        assert!(whole.drones[0].name.ends_with("east") && whole.drones[0].name.contains("site"), "{whole:?}");
    }
}
