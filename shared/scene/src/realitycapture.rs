//! Reads the cameras of RealityCapture and RealityScan: *Internal/External camera parameters* (CSV), and the XMP files that
//! it writes beside the photographs.
//!
//! Both give focal lengths for a film of 36 mm along the longer side, and the principal point as a share of that side
//! ("RealityCapture XMP Camera Math", Epic Games). Lenses without distortion and of all of Brown's models are read.
//!
//! What it knows nothing about: coordinate systems; the world is that of the export.

mod csv;
mod film;
mod xmp;

use std::path::{Path, PathBuf};

use crate::shot::Shot;
use crate::{SceneError, xml};

/// Most files of a folder that are looked at.
const ENTRIES_MAX: usize = 100_000;

/// Whether a file's beginning is that of the CSV file.
pub(crate) fn is_csv(head: &str) -> bool {
    csv::is_one(head)
}

/// Reads the CSV file `path`. The pictures must be there: the file does not tell their sizes.
pub(crate) fn read_csv(path: &Path) -> Result<Vec<Shot>, SceneError> {
    csv::read(path)
}

/// The XMP files with poses in a folder of pictures, in the order of names; empty if the first XMP file has none.
pub(crate) fn xmp_files(folder: &Path) -> Vec<PathBuf> {
    let entries =
        folder.read_dir().into_iter().flatten().take(ENTRIES_MAX).flatten().map(|entry| entry.path());
    let is_xmp = |path: &PathBuf| path.extension().is_some_and(|end| end.eq_ignore_ascii_case("xmp"));
    let mut files: Vec<PathBuf> = entries.filter(is_xmp).collect();
    files.sort();
    let has_poses = files.first().is_some_and(|first| xml::head(first).contains(xmp::NAMESPACE));
    if has_poses { files } else { Vec::new() }
}

/// Reads XMP files, each beside its picture. Those without a pose are of photographs that were not aligned.
pub(crate) fn read_xmp(files: &[PathBuf]) -> Result<Vec<Shot>, SceneError> {
    files.iter().filter_map(|file| xmp::read(file).transpose()).collect()
}
