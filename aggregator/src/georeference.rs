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
    #[error("{} and {} have different origins in {}; make both about one origin, or leave one out", first.display(), second.display(), Georeference::FILE)]
    OtherOrigin {
        /// A folder.
        first: PathBuf,
        /// A folder whose world has another origin.
        second: PathBuf,
    },
}

/// The georeference of the first of these folders that has one; `None` if none has. All that have one must agree on the
/// origin, because their worlds are about it.
pub fn common_georeference(folders: &[PathBuf]) -> Result<Option<Georeference>, GeoreferenceError> {
    let mut common: Option<(&PathBuf, Georeference)> = None;
    for folder in folders {
        match (&common, Georeference::of_folder(folder)?) {
            (Some((first, known)), Some(other)) if known.origin != other.origin => {
                let (first, second) = ((*first).clone(), folder.clone());
                return Err(GeoreferenceError::OtherOrigin { first, second });
            }
            (None, Some(found)) => common = Some((folder, found)),
            _ => {}
        }
    }
    Ok(common.map(|(_, georeference)| georeference))
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
    use cosurf_geo::Geodetic;

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
}
