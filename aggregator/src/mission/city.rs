//! The synthetic city, for a mission without a dataset: rendered once, and kept beside the results.

use std::fs;
use std::path::Path;

use cosurf_city::{City, CityError, CitySettings};
use cosurf_scene::{SceneError, atomic, files};

/// Why the city cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MakeCityError {
    /// The city cannot be built.
    #[error(transparent)]
    City(#[from] CityError),
    /// The city cannot be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
}

/// Makes the city in `folder`, unless a complete city of the same settings is in the folder already. Calls `progress`
/// after each rendered picture, with the number of pictures rendered so far and the number of all pictures.
pub(crate) fn make(
    settings: &CitySettings,
    folder: &Path,
    progress: impl FnMut(usize, usize),
) -> Result<(), MakeCityError> {
    // While a city is written, its record is empty.
    let record = folder.join("city.txt");
    let content = format!("{settings:?}\n");
    if fs::read_to_string(&record).is_ok_and(|there| there == content) {
        return Ok(());
    }
    let city = City::build(settings)?;
    files::create_folder(folder)?;
    atomic::write_bytes(&record, b"")?;
    city.write(folder, progress)?;
    Ok(atomic::write_bytes(&record, content.as_bytes())?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::panic::catch_unwind;

    use cosurf_scene::Dataset;

    use super::*;

    #[test]
    fn a_city_is_made_again_only_if_it_is_incomplete_or_another() {
        let folder = tempfile::tempdir().unwrap();
        let small = CitySettings { extent_m: 40.0, views: 4, size_px: [32, 24], ..CitySettings::default() };
        let pictures = |settings: &CitySettings| {
            let mut count = 0;
            make(settings, folder.path(), |_, _| count += 1).unwrap();
            count
        };
        assert_eq!((pictures(&small), pictures(&small)), (4, 0));
        assert_eq!(Dataset::open(folder.path()).unwrap().views.len(), 4);
        assert_eq!(pictures(&CitySettings { seed: 8, ..small }), 4);
        fs::remove_file(folder.path().join("city.txt")).unwrap();
        assert_eq!(pictures(&CitySettings { seed: 8, ..small }), 4);
        let killed = catch_unwind(|| make(&small, folder.path(), |done, _| assert!(done < 2)));
        assert!(killed.is_err());
        assert_eq!(pictures(&CitySettings { seed: 8, ..small }), 4, "the pictures are of two cities");
    }
}
