//! Reads the documents, and the parts of Markdown that the tests need.

use std::fs;
use std::path::{Path, PathBuf};

/// The root of the workspace.
pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// The text of a file below the root.
pub(crate) fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap()
}

/// Paths of the README and of the documents in `shared/docs`, relative to the root.
pub(crate) fn documents() -> Vec<String> {
    let entries = fs::read_dir(root().join("shared/docs")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let docs = names.filter(|name| name.ends_with(".md")).map(|name| format!("shared/docs/{name}"));
    let mut documents: Vec<String> = docs.chain(["README.md".to_owned()]).collect();
    documents.sort_unstable();
    documents
}

/// The lines of a document, without the fences of code blocks. A line in a code block comes with the language of the
/// block, a line outside with `None`.
pub(crate) fn lines(document: &str) -> Vec<(Option<&str>, &str)> {
    let mut language = None;
    let mut lines = Vec::new();
    for line in document.lines() {
        match (line.trim_start().strip_prefix("```"), language) {
            (Some(name), None) => language = Some(name.trim()),
            (Some(_), Some(_)) => language = None,
            (None, _) => lines.push((language, line)),
        }
    }
    lines
}
