//! Pictures with poses whose lenses may be distorted, before they are undistorted.
//!
//! What it knows nothing about: the formats of the files that tell the poses.

use std::path::{Path, PathBuf};

use crate::error::Refusal;
use crate::lens::Lens;
use crate::{Picture, Pose, SceneError, View, files};

/// Extensions to append if a name names no file: many tools leave the extension out.
const EXTENSIONS: [&str; 9] = ["png", "jpg", "jpeg", "webp", "tif", "tiff", "bmp", "JPG", "PNG"];

/// Quality of JPEGs that COLMAP compresses again: their loss is below that of a photograph.
const STRAIGHT_QUALITY: u8 = 98;

/// A picture with its pose and its lens.
#[derive(Clone, Debug, PartialEq)]
pub struct Shot {
    /// Name of the picture's file below the folder of the pictures.
    pub name: String,
    /// The picture's file.
    pub path: PathBuf,
    /// Maps world points into the camera's frame.
    pub cam_from_world: Pose,
    /// The lens, for the picture's size on disk if [`crate::Distorted::open`] returned the shot.
    pub lens: Lens,
}

impl Shot {
    /// The shot as it is without the distortion of a lens that COLMAP does not know, with its picture in `folder`, which
    /// [`Self::write_straight`] writes. `None` if COLMAP can undistort the picture.
    pub fn straight(&self, folder: &Path) -> Result<Option<Self>, SceneError> {
        if self.lens.is_known_to_colmap() {
            return Ok(None);
        }
        let lens = self.lens.straight().map_err(|refusal| refusal.of(&self.path))?;
        // The extension tells COLMAP the format.
        let name = match is_jpeg(&self.name) || has_extension(&self.name, "png") {
            true => self.name.clone(),
            false => format!("{}.png", self.name),
        };
        Ok(Some(Self { path: folder.join(&name), name, lens, cam_from_world: self.cam_from_world }))
    }

    /// Writes the picture of `straight`, which [`Self::straight`] returned.
    pub fn write_straight(&self, straight: &Self) -> Result<(), SceneError> {
        let picture = Picture::read_fitted(&self.path, self.lens.size_px)?;
        let picture = self.lens.straightened(&picture, &straight.lens);
        match is_jpeg(&straight.name) {
            true => picture.write_jpeg(&straight.path, STRAIGHT_QUALITY),
            false => picture.write_png(&straight.path),
        }
    }

    /// The view, if the lens is that of a pinhole. `file` names the export in the refusal.
    pub(crate) fn into_view(self, file: &Path) -> Result<View, SceneError> {
        if self.lens.is_distorted() {
            return Err(distorted(&self.name).of(file));
        }
        let camera = self.lens.pinhole(self.cam_from_world);
        Ok(View { name: self.name, camera, path: self.path, mask: None })
    }
}

fn is_jpeg(name: &str) -> bool {
    has_extension(name, "jpg") || has_extension(name, "jpeg")
}

fn has_extension(name: &str, extension: &str) -> bool {
    Path::new(name).extension().is_some_and(|found| found.eq_ignore_ascii_case(extension))
}

/// The refusal of a distorted lens, with what undistorts it.
fn distorted(name: &str) -> Refusal {
    format!(
        "the lens of {} is distorted; undistort the pictures with `cosurf-agent ingest FOLDER --out DATA`, where FOLDER holds this file, and give DATA",
        name.escape_debug()
    )
    .into()
}

/// The folder of the pictures of an export: `images` beside its file, or its own folder.
pub(crate) fn picture_folder(file: &Path) -> PathBuf {
    let root = file.parent().unwrap_or(Path::new(""));
    let images = root.join("images");
    if images.is_dir() { images } else { root.to_owned() }
}

/// The name and the path of a picture that an export names, often without its extension. If no such file exists, both are
/// as named.
pub(crate) fn find_picture(folder: &Path, named: &str) -> (String, PathBuf) {
    let exact = files::in_any_case(folder.join(named));
    let with = |extension: &&str| folder.join(format!("{named}.{extension}"));
    let path = match exact.is_file() {
        true => exact,
        false => EXTENSIONS.iter().map(with).find(|path| path.is_file()).unwrap_or(exact),
    };
    let name = path.strip_prefix(folder).ok().and_then(Path::to_str).unwrap_or(named).to_owned();
    (name, path)
}
