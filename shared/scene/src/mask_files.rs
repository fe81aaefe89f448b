//! Finds the masks of a dataset's pictures, and tells what they hide.
//!
//! A mask lies in the folder `masks` beside `images`, or is named by the dataset. In a folder `masks_inverted`, black marks the
//! pixels that count.

use std::path::{Path, PathBuf};

use crate::{Dataset, Mask, SceneError, View, mask};

/// The folder of masks in which white pixels count.
const MASKS: &str = "masks";
/// The folder of masks in which black pixels count.
const INVERTED: &str = "masks_inverted";
/// Number of pictures whose masks are compared with the sparse points.
const COMPARED: usize = 6;
/// Long side at which they are compared, px.
const COMPARED_PX: u32 = 512;
/// If masks hide more than this share of the sparse points, they are perhaps the wrong way round.
const HIDDEN_MAX: f64 = 0.5;

/// The mask in a file that a dataset names.
pub(crate) fn named(path: PathBuf) -> Mask {
    let is_inverted = path.components().any(|part| part.as_os_str() == INVERTED);
    Mask { path, is_inverted }
}

/// The mask of the picture called `name`, in the folder `masks` or `masks_inverted` of `beside`; `None` if it has none.
pub fn mask_of(beside: &Path, name: &Path) -> Option<Mask> {
    [MASKS, INVERTED].iter().find_map(|masks| find(&beside.join(masks), name)).map(named)
}

/// Whether a folder of this name holds masks.
pub fn is_of_masks(folder: &str) -> bool {
    [MASKS, INVERTED].contains(&folder)
}

/// Gives each view that has none the mask of its picture in a folder of masks, if there is one. `root` is the dataset's folder.
pub(crate) fn attach(root: &Path, views: &mut [View]) {
    for view in views.iter_mut().filter(|view| view.mask.is_none()) {
        let images = view.path.ancestors().find(|folder| folder.ends_with("images"));
        let (beside, folder) = match images {
            Some(images) => (images.parent().unwrap_or(Path::new("")), images),
            None => (root, root),
        };
        let inner = view.path.strip_prefix(folder).unwrap_or(Path::new(&view.name));
        view.mask = mask_of(beside, inner);
    }
}

/// An error if a mask that the dataset names is missing.
pub(crate) fn refuse_missing(views: &[View]) -> Result<(), SceneError> {
    let missing = views.iter().filter_map(|view| view.mask.as_ref()).find(|mask| !mask.path.is_file());
    missing.map_or(Ok(()), |mask| {
        let reason = "this mask is missing; add it, or remove `mask_path` from the frames of transforms.json";
        Err(SceneError::malformed(&mask.path, reason))
    })
}

/// Lines about masks: how many pictures have one, and whether they seem to be the wrong way round.
pub(crate) fn notes(dataset: &Dataset) -> Vec<String> {
    let masked: Vec<&View> = dataset.views.iter().filter(|view| view.mask.is_some()).collect();
    let Some(folder) = masked.first().and_then(|view| view.mask.as_ref()?.path.parent()) else {
        return Vec::new();
    };
    let (of, folder) = (dataset.views.len(), folder.display());
    let mut notes =
        vec![format!("{folder}: {} of {of} pictures have masks; what they hide is left out", masked.len())];
    let share = hidden_share(dataset);
    if share > HIDDEN_MAX {
        let percent = 100.0 * share;
        notes.push(format!(
            "{folder}: hide {percent:.0} % of the sparse points; if the other pixels should count, name the folder \
             {INVERTED}, or {MASKS} if that is its name"
        ));
    }
    notes
}

/// Share of the sparse points that masks hide in some of the pictures. Masks that cannot be read are left out here: training
/// tells why.
fn hidden_share(dataset: &Dataset) -> f64 {
    let with_mask: Vec<usize> =
        (0..dataset.views.len()).filter(|i| dataset.views[*i].mask.is_some()).collect();
    let mut totals = [0; 2];
    for &i in with_mask.iter().step_by(with_mask.len().div_ceil(COMPARED).max(1)) {
        let view = &dataset.views[i];
        let camera = view.camera.fitted(COMPARED_PX);
        let seen = dataset
            .points
            .iter()
            .filter(|point| point.views.is_empty() || point.views.binary_search(&(i as u32)).is_ok());
        let places: Vec<[f64; 2]> =
            seen.filter_map(|point| camera.project(point.position)).map(|place| place.to_array()).collect();
        let counts = view.mask.as_ref().map(|its| mask::hidden(its, camera.size_px, &places));
        if let Some(Ok([hidden, of])) = counts {
            totals = [totals[0] + hidden, totals[1] + of];
        }
    }
    totals[0] as f64 / totals[1].max(1) as f64
}

/// The file of the mask of the picture called `name` in the folder `masks`: COLMAP's `name.jpg.png`, or a picture of the same
/// name, with its own suffix or with `.png`. `None` if it is not there.
fn find(masks: &Path, name: &Path) -> Option<PathBuf> {
    let own = masks.join(name);
    let mut with_png = own.clone().into_os_string();
    with_png.push(".png");
    [PathBuf::from(with_png), own.with_extension("png"), own].into_iter().find(|path| path.is_file())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use super::*;

    #[test]
    fn masks_are_found_by_the_names_of_several_tools() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("a")).unwrap();
        for name in ["1.jpg.png", "2.png", "3.jpg", "a/4.JPG.png"] {
            fs::write(folder.path().join(name), "").unwrap();
        }
        let name = |name| {
            find(folder.path(), Path::new(name))
                .map(|path| path.strip_prefix(folder.path()).unwrap().to_owned())
        };
        for (picture, mask) in
            [("1.jpg", "1.jpg.png"), ("2.jpg", "2.png"), ("3.jpg", "3.jpg"), ("a/4.JPG", "a/4.JPG.png")]
        {
            assert_eq!(name(picture), Some(PathBuf::from(mask)));
        }
        assert_eq!(name("5.jpg"), None);
    }
}
