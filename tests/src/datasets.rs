//! Datasets for tests and benches: synthetic cities, and datasets that may lie beside the checkout.

use std::path::{Path, PathBuf};

use cosurf_city::{City, CitySettings};

/// Writes a synthetic city of `extent_m` × `extent_m` metres, photographed in `views` pictures, into `folder`.
pub fn write_city(folder: &Path, extent_m: f64, views: u32, size_px: [u32; 2]) {
    let settings = CitySettings { extent_m, views, size_px, ..CitySettings::default() };
    City::build(&settings).unwrap().write(folder, |_, _| ()).unwrap();
}

/// The folder of a dataset in `../shared/data`, relative to the checkout; `None` if it does not exist.
pub fn shared_dataset(name: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name);
    folder.is_dir().then_some(folder)
}

/// The default dataset of benches: `gt_boruszyn` (rendered pictures of Boruszyn) if it exists. Otherwise writes a
/// synthetic city with 48 pictures into `folder`, and returns `folder`.
pub fn default_dataset(folder: &Path) -> PathBuf {
    shared_dataset("gt_boruszyn").unwrap_or_else(|| {
        write_city(folder, 80.0, 48, CitySettings::default().size_px);
        folder.to_path_buf()
    })
}

/// The file with a dataset's true surface, as points or as a mesh; `None` if the dataset has none.
pub fn true_surface(data: &Path) -> Option<PathBuf> {
    ["gt/points.ply", "gt/mesh.ply"].map(|name| data.join(name)).into_iter().find(|file| file.is_file())
}
