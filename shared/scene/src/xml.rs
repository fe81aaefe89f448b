//! Reads XML that other programs wrote.
//!
//! What it knows nothing about: what the elements mean.

use std::io::Read;
use std::path::Path;

use roxmltree::{Document, Node, ParsingOptions};

use crate::error::Refusal;
use crate::{SceneError, files};

/// Longest accepted file, bytes; 10,000 cameras take about 20 MB.
const FILE_BYTES_MAX: u64 = 1 << 28;
/// Most elements, attributes and texts of a document.
const NODES_MAX: u32 = 10_000_000;

/// The text of a file, with a bound on its length.
pub(crate) fn read(path: &Path) -> Result<String, SceneError> {
    let mut bytes = Vec::new();
    let read = files::open(path)?.take(FILE_BYTES_MAX + 1).read_to_end(&mut bytes);
    read.map_err(|cause| SceneError::io(path, cause))?;
    if bytes.len() as u64 > FILE_BYTES_MAX {
        return Err(SceneError::malformed(path, "is longer than 256 MiB, too long for poses of cameras"));
    }
    String::from_utf8(bytes).map_err(|_| SceneError::malformed(path, "is not a text in UTF-8"))
}

/// The first bytes of a file as text; empty if it cannot be read.
pub(crate) fn head(path: &Path) -> String {
    let mut bytes = Vec::new();
    let read = files::open(path).map(|file| file.take(4096).read_to_end(&mut bytes));
    if read.is_err() { String::new() } else { String::from_utf8_lossy(&bytes).into_owned() }
}

/// Documents with a document type are refused: their entities may expand without end.
pub(crate) fn parse(text: &str) -> Result<Document<'_>, Refusal> {
    let options = ParsingOptions { allow_dtd: false, nodes_limit: NODES_MAX, ..ParsingOptions::default() };
    let text = text.trim_start_matches('\u{FEFF}');
    Document::parse_with_options(text, options).map_err(|error| format!("is not valid XML: {error}").into())
}

/// The first child element of this name.
pub(crate) fn child<'a>(node: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
    node.children().find(|child| child.tag_name().name() == name)
}

/// The text of the first child element of this name.
pub(crate) fn text<'a>(node: Node<'a, 'a>, name: &str) -> Option<&'a str> {
    child(node, name)?.text()
}

/// The finite number in the child element of this name; `None` if there is no such element.
pub(crate) fn value(node: Node, name: &str) -> Result<Option<f64>, Refusal> {
    text(node, name).map(|text| numbers::<1>(text).map(|[number]| number)).transpose()
}

/// An attribute that must be there.
pub(crate) fn attribute<'a>(node: Node<'a, 'a>, name: &str) -> Result<&'a str, Refusal> {
    let missing = || format!("an element {} has no attribute {name}", node.tag_name().name()).into();
    node.attribute(name).ok_or_else(missing)
}

/// Exactly `N` finite numbers, separated by white space.
pub(crate) fn numbers<const N: usize>(text: &str) -> Result<[f64; N], Refusal> {
    let mut found = [0.0; N];
    let mut words = text.split_whitespace();
    for number in &mut found {
        let parsed =
            words.next().and_then(|word| word.parse().ok()).filter(|number: &f64| number.is_finite());
        *number = parsed.ok_or_else(|| wrong(N, text))?;
    }
    if words.next().is_some() { Err(wrong(N, text)) } else { Ok(found) }
}

fn wrong(count: usize, text: &str) -> Refusal {
    let shown: String = text.chars().take(60).collect();
    format!("'{}' is not {count} finite numbers", shown.escape_debug()).into()
}
