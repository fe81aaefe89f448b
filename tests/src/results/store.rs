//! Reads and writes results as JSON files.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::machine;
use super::record::Results;

/// The folder of the stored results, which the documents show.
pub fn folder() -> PathBuf {
    machine::root().join("shared/docs/results")
}

/// Writes results to `NAME.json` in a folder.
pub fn write(folder: &Path, results: &Results) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let text = serde_json::to_string_pretty(results)? + "\n";
    fs::write(file(folder, &results.name), text)
}

/// Reads the results from `NAME.json` in a folder; `None` if there is no such file. Fails if the file is invalid or
/// holds results of another name.
pub fn read(folder: &Path, name: &str) -> io::Result<Option<Results>> {
    let file = file(folder, name);
    match fs::read(&file) {
        Ok(text) => {
            let results: Results = serde_json::from_slice(&text).map_err(|error| bad(&file, error))?;
            let fits = |row: &super::Row| row.values.len() == results.columns.len();
            match results.name == name && results.rows.iter().all(fits) {
                true => Ok(Some(results)),
                false => Err(bad(&file, "another name, or rows that do not fit the columns")),
            }
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(bad(&file, error)),
    }
}

/// Reads all results in a folder, sorted by name. Fails as [`read`] does.
pub fn read_all(folder: &Path) -> io::Result<Vec<Results>> {
    names(folder)?.iter().filter_map(|name| read(folder, name).transpose()).collect()
}

/// The names of all results in a folder, sorted.
pub fn names(folder: &Path) -> io::Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name();
        names.extend(name.to_str().and_then(|name| name.strip_suffix(".json")).map(str::to_owned));
    }
    names.sort_unstable();
    Ok(names)
}

fn file(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{name}.json"))
}

fn bad(file: &Path, error: impl std::fmt::Display) -> io::Error {
    io::Error::other(format!("{}: {error}", file.display()))
}
