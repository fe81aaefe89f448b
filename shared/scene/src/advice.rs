//! What a path is, if it is no dataset, and which command makes a dataset of it.
//!
//! What it knows nothing about: datasets that can be read.

use std::path::Path;

/// Entries of a folder that are looked at for pictures.
const ENTRIES_MAX: usize = 1000;
/// Extensions of pictures.
const PICTURES: [&str; 7] = ["jpg", "jpeg", "png", "webp", "tif", "tiff", "bmp"];
/// Extensions of videos.
const VIDEOS: [&str; 6] = ["mp4", "mov", "avi", "mkv", "m4v", "webm"];
/// Extensions of archives.
const ARCHIVES: [&str; 5] = ["zip", "tar", "gz", "7z", "rar"];

/// Makes photographs of a video.
pub const FRAMES_COMMAND: &str = "ffmpeg -i VIDEO -vf fps=2 PHOTOS/%05d.jpg";

/// Whether a file is a video by its name.
pub fn is_video(path: &Path) -> bool {
    VIDEOS.iter().any(|known| has_extension(path, known))
}

/// What to do with a file that is no `transforms.json`; `None` if it may be one.
pub(crate) fn for_file(path: &Path) -> Option<String> {
    let is = |known: &[&str]| known.iter().any(|known| has_extension(path, known));
    if is_video(path) {
        return Some(format!(
            "is a video; extract photographs with `{FRAMES_COMMAND}`, then run `cosurf-agent ingest PHOTOS --out DATA`"
        ));
    }
    if is(&ARCHIVES) {
        return Some("is an archive; unpack it, and give the folder".into());
    }
    if is(&PICTURES) {
        return Some("is a picture; give the folder of the dataset".into());
    }
    is(&["xml", "csv"]).then(|| {
        "is neither Metashape's XML of cameras nor RealityCapture's CSV of `Internal/External camera parameters`; export that, \
         or let `cosurf-agent ingest PHOTOS --out DATA` find the poses"
            .into()
    })
}

/// Why a folder, or a path that does not exist, is no dataset, and what to do about it.
pub(crate) fn for_folder(path: &Path) -> String {
    if !path.is_dir() {
        return "there is no such folder".into();
    }
    if path.join("opensfm").is_dir() {
        let project = path.join("opensfm");
        return format!(
            "is a project of OpenDroneMap; give {}, which `opensfm undistort {}` makes if it is not there",
            project.join("undistorted").display(),
            project.display()
        );
    }
    if has_pictures(path) || has_pictures(&path.join("images")) {
        return format!(
            "holds photographs without poses; run `cosurf-agent ingest {} --out DATA`, then give DATA",
            path.display()
        );
    }
    if let Some(file) = first(path, |path| for_file(path).is_some()) {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        return format!("holds no dataset; {name} {}", for_file(&file).unwrap_or_default());
    }
    "holds no dataset; give a folder with images/ and either sparse/0/cameras.bin (COLMAP), transforms.json, reconstruction.json (OpenSfM), or cameras of Metashape or RealityCapture"
        .into()
}

/// Whether some of a folder's first entries are pictures by their names.
pub(crate) fn has_pictures(folder: &Path) -> bool {
    first(folder, |path| PICTURES.iter().any(|known| has_extension(path, known))).is_some()
}

fn has_extension(path: &Path, known: &str) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case(known))
}

/// The first file of a folder, in the order of names, that is so.
fn first(folder: &Path, is_so: impl Fn(&Path) -> bool) -> Option<std::path::PathBuf> {
    let entries = folder.read_dir().into_iter().flatten().take(ENTRIES_MAX).flatten();
    entries.map(|entry| entry.path()).filter(|path| is_so(path)).min()
}
