//! What a dataset has that is not used, told in a line each: a training that ignores depths in silence looks as if it had
//! used them.
//!
//! What it knows nothing about: how datasets are read.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::de::IgnoredAny;

use crate::{Picture, View, colmap, files};

/// Longest `transforms.json` that is looked through, bytes.
const FILE_BYTES_MAX: u64 = 1 << 28;

/// The lines for a dataset. `first` is one of its views.
pub(crate) fn of(path: &Path, first: Option<&View>) -> Vec<String> {
    let mut notes = Vec::new();
    let root = files::folder_of(path);
    notes.extend(other_models(root));
    let file = if path.is_file() { path.to_owned() } else { path.join("transforms.json") };
    if path.is_file() || colmap::find_model(root).is_none() {
        notes.extend(unused_fields(&file));
    }
    notes.extend(first.and_then(orientation));
    notes
}

/// The models of COLMAP that have fewer pictures than the one that is read.
fn other_models(root: &Path) -> Option<String> {
    let models = [root.join("sparse"), root.to_owned()].map(|folder| colmap::numbered_models(&folder));
    let models = models.into_iter().find(|models| !models.is_empty())?;
    let [(used, most), others @ ..] = &models[..] else { return None };
    let told = |(model, pictures): &(PathBuf, u64)| format!("{} ({pictures})", model.display());
    let others: Vec<String> = others.iter().map(told).collect();
    (!others.is_empty())
        .then(|| format!("{}: used, with {most} pictures; not used: {}", used.display(), others.join(", ")))
}

/// The fields of a `transforms.json` that are not read, if they are there.
#[derive(Deserialize)]
struct Fields {
    #[serde(default)]
    frames: Vec<FrameFields>,
    train_filenames: Option<IgnoredAny>,
    val_filenames: Option<IgnoredAny>,
    test_filenames: Option<IgnoredAny>,
}

#[derive(Deserialize)]
struct FrameFields {
    depth_file_path: Option<IgnoredAny>,
}

fn unused_fields(file: &Path) -> Vec<String> {
    let Ok(opened) = File::open(file) else { return Vec::new() };
    if opened.metadata().is_ok_and(|metadata| metadata.len() > FILE_BYTES_MAX) {
        return Vec::new();
    }
    let Ok(fields) = serde_json::from_reader::<_, Fields>(BufReader::new(opened)) else { return Vec::new() };
    let lists = [&fields.train_filenames, &fields.val_filenames, &fields.test_filenames];
    let told = [
        (fields.frames.iter().any(|frame| frame.depth_file_path.is_some()), "depth_file_path is not used"),
        (
            lists.iter().any(|list| list.is_some()),
            "train_filenames, val_filenames and test_filenames are not used; every n-th view is held out",
        ),
    ];
    let told = told.into_iter().filter(|(is_there, _)| *is_there);
    told.map(|(_, text)| format!("{}: {text}", file.display())).collect()
}

/// Poses of COLMAP belong to the rows as they are stored, those of other tools often to the upright picture.
fn orientation(view: &View) -> Option<String> {
    let orientation = Picture::orientation(&view.path).filter(|orientation| *orientation != 1)?;
    Some(format!(
        "{}: has EXIF orientation {orientation}, which is not applied: the poses must belong to the rows as they are stored",
        view.path.display()
    ))
}
