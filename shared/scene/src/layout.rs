//! Where the poses of a dataset are, and in which format.
//!
//! What it knows nothing about: the content of the files, but for their first bytes.

use std::path::{Path, PathBuf};

use crate::{SceneError, advice, camera_list, colmap, metashape, opensfm, realitycapture, xml};

/// Most files of a folder that are looked into.
const ENTRIES_MAX: usize = 1000;

/// Where the poses of a dataset are: a file, the folder of a COLMAP model, or files beside the pictures.
pub(crate) enum Layout {
    Colmap(PathBuf),
    Transforms(PathBuf),
    OpenSfm(PathBuf),
    CameraList(PathBuf),
    Metashape(PathBuf),
    RealityCaptureCsv(PathBuf),
    RealityCaptureXmp(Vec<PathBuf>),
}

impl Layout {
    /// The layout of a dataset that is named by its folder or by a file.
    pub(crate) fn of(path: &Path) -> Result<Self, SceneError> {
        match path.is_file() {
            true => Self::of_file(path),
            false => {
                Self::of_folder(path).ok_or_else(|| SceneError::malformed(path, advice::for_folder(path)))
            }
        }
    }

    /// The layout of a folder; `None` if it has no poses.
    pub(crate) fn of_folder(folder: &Path) -> Option<Self> {
        let file = |name: &str| Some(folder.join(name)).filter(|path| path.is_file());
        colmap::find_model(folder)
            .map(Self::Colmap)
            .or_else(|| file("transforms.json").map(Self::Transforms))
            .or_else(|| file(opensfm::FILE).map(Self::OpenSfm))
            .or_else(|| file(camera_list::FILE).map(Self::CameraList))
            .or_else(|| exports(folder).find_map(|path| Self::of_export(&path)))
            .or_else(|| {
                let files = [folder.join("images"), folder.to_owned()]
                    .map(|folder| realitycapture::xmp_files(&folder));
                files.into_iter().find(|files| !files.is_empty()).map(Self::RealityCaptureXmp)
            })
    }

    /// The layout of a dataset that is named by a file of its own. Any file that is no known mistake may be a
    /// `transforms.json` of another name.
    fn of_file(path: &Path) -> Result<Self, SceneError> {
        let path_buf = path.to_path_buf();
        match path.file_name().and_then(|name| name.to_str()) {
            Some(camera_list::FILE) => Ok(Self::CameraList(path_buf)),
            Some(opensfm::FILE) => Ok(Self::OpenSfm(path_buf)),
            _ => match Self::of_export(path).ok_or_else(|| advice::for_file(path)) {
                Ok(layout) => Ok(layout),
                Err(Some(advice)) => Err(SceneError::malformed(path, advice)),
                Err(None) => Ok(Self::Transforms(path_buf)),
            },
        }
    }

    /// The layout of a file that Metashape or RealityCapture wrote, by its first bytes.
    fn of_export(path: &Path) -> Option<Self> {
        let head = || xml::head(path);
        match path.extension()?.to_ascii_lowercase().to_str()? {
            "xml" => metashape::is_one(&head()).then(|| Self::Metashape(path.to_owned())),
            "csv" => realitycapture::is_csv(&head()).then(|| Self::RealityCaptureCsv(path.to_owned())),
            _ => None,
        }
    }
}

/// The files of a folder that may be exports, in the order of names.
fn exports(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    let entries =
        folder.read_dir().into_iter().flatten().take(ENTRIES_MAX).flatten().map(|entry| entry.path());
    let may_be = |path: &PathBuf| {
        path.extension().is_some_and(|end| end.eq_ignore_ascii_case("xml") || end.eq_ignore_ascii_case("csv"))
    };
    let mut files: Vec<PathBuf> = entries.filter(may_be).collect();
    files.sort();
    files.into_iter()
}
