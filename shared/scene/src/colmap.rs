//! COLMAP models, binary and text: `cameras`, `images` and `points3D`.
//!
//! Cameras must be `PINHOLE` or `SIMPLE_PINHOLE`, as splats are projected without lens distortion. The
//! error for other cameras gives the COLMAP command that undistorts the pictures. Coordinate frames
//! and pixels are as in [`crate::camera`]; quaternions are stored as wxyz.

mod binary;
mod model;
#[cfg(test)]
mod tests;
mod text;
mod write;

use std::fs::File;
use std::io::{self, BufReader, Cursor};
use std::path::{Path, PathBuf};

use crate::sieve::Sieve;
use crate::{Dataset, SceneError, View, files};
use model::Undistortion;
pub use write::{write, write_shots};

/// The folder that holds a model: `root` or a folder below it; `None` if there is no model. Of several in folders with
/// numbers, as COLMAP writes them, the one with most pictures.
pub(crate) fn find_model(root: &Path) -> Option<PathBuf> {
    [root.join("sparse"), root.to_owned()].into_iter().find_map(|folder| {
        let best = numbered_models(&folder).into_iter().next().map(|(model, _)| model);
        best.or_else(|| is_model(&folder).then_some(folder))
    })
}

/// The models in folders of `folder` that have numbers for names, with their numbers of pictures; most pictures first.
pub(crate) fn numbered_models(folder: &Path) -> Vec<(PathBuf, u64)> {
    let number = |path: &Path| path.file_name()?.to_str()?.parse::<u32>().ok();
    let entries = folder.read_dir().into_iter().flatten().flatten().map(|entry| entry.path());
    let mut models: Vec<(u32, PathBuf)> =
        entries.filter(|path| is_model(path)).filter_map(|path| Some((number(&path)?, path))).collect();
    models.sort();
    if let [(_, only)] = &models[..] {
        return vec![(only.clone(), 0)]; // nothing to compare it with
    }
    let mut models: Vec<(PathBuf, u64)> =
        models.into_iter().map(|(_, path)| (path.clone(), pictures_of(&path))).collect();
    models.sort_by_key(|(_, pictures)| std::cmp::Reverse(*pictures));
    models
}

fn is_model(folder: &Path) -> bool {
    is_binary(folder) || folder.join("cameras.txt").is_file()
}

/// Number of pictures of a model; 0 if its file cannot be read, which reading the model tells.
fn pictures_of(model: &Path) -> u64 {
    let count = match is_binary(model) {
        true => binary::count_images(&model.join("images.bin")),
        false => text::count_images(&model.join("images.txt")),
    };
    count.unwrap_or(0)
}

fn is_binary(model: &Path) -> bool {
    model.join("cameras.bin").is_file()
}

/// Folders that may hold the pictures of the model in the folder `model`, likeliest first. `root` is the folder
/// that the caller opens.
fn picture_folders(root: &Path, model: &Path) -> Vec<PathBuf> {
    let above = model.ancestors().skip(1).take(2).map(|above| above.join("images"));
    std::iter::once(root.join("images")).chain(above).collect()
}

/// The folder that most likely holds the pictures of the model in the folder `model`, which is `root` or a folder below it.
pub(crate) fn picture_folder(root: &Path, model: &Path) -> PathBuf {
    picture_folders(root, model).into_iter().find(|folder| folder.is_dir()).unwrap_or_else(|| root.to_owned())
}

/// Reads the model in the folder `model`, which is `root` or a folder below it, and its points into `sieve`. Views keep the
/// file's order. Each view gets the path at which its picture should be; the pictures may be missing, and the file of the
/// points too.
pub(crate) fn read(root: &Path, model: &Path, sieve: &mut Sieve) -> Result<Vec<View>, SceneError> {
    let folders = picture_folders(root, model);
    let likely = folders.iter().find(|folder| folder.is_dir()).unwrap_or(&folders[0]);
    let undistortion = Undistortion { images: likely, model, root };
    let mut views = match is_binary(model) {
        true => binary::read(model, &undistortion, sieve, open_file)?,
        false => text::read(model, &undistortion, sieve, open_file)?,
    };
    let first = views.first().map_or("", |view| &view.name);
    let beside = root.to_owned();
    let holds_first = |folder: &&PathBuf| folder.join(first).is_file();
    let folder = folders.iter().chain([&beside]).find(holds_first).unwrap_or(likely).clone();
    for view in &mut views {
        view.path = files::in_any_case(folder.join(&view.name));
    }
    Ok(views)
}

/// Opens a file; returns it with its length in bytes.
fn open_file(path: &Path) -> io::Result<(BufReader<File>, u64)> {
    let file = File::open(path)?;
    let bytes = file.metadata()?.len();
    Ok((BufReader::new(file), bytes))
}

/// The two forms of a model's files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Binary files, `*.bin`.
    Binary,
    /// Text files, `*.txt`.
    Text,
}

/// Parses a model from memory. `files` are the contents of `cameras`, `images` and `points3D`, in this order. The
/// paths of the views are empty.
pub fn parse(form: Form, files: [&[u8]; 3]) -> Result<Dataset, SceneError> {
    let open = |path: &Path| {
        let stem = path.file_stem().unwrap_or_default();
        let found = ["cameras", "images", "points3D"].iter().position(|name| stem == *name);
        let bytes = files[found.ok_or(io::ErrorKind::NotFound)?];
        Ok((Cursor::new(bytes), bytes.len() as u64))
    };
    let here = Path::new("");
    let undistortion = Undistortion { images: here, model: here, root: here };
    let mut sieve = Sieve::new(usize::MAX);
    let views = match form {
        Form::Binary => binary::read(here, &undistortion, &mut sieve, open)?,
        Form::Text => text::read(here, &undistortion, &mut sieve, open)?,
    };
    Ok(Dataset { views, points: sieve.end().0 })
}
