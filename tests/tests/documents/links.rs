//! Checks that every relative link and every anchor in the documents has a target.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::text::{documents, lines, root};

/// The targets of the links and pictures of a document.
fn targets(document: &str) -> Vec<String> {
    let prose = lines(document)
        .into_iter()
        .filter(|(language, _)| language.is_none())
        .map(|(_, line)| without_code(line));
    let prose: Vec<String> = prose.collect();
    let starts = prose.iter().flat_map(|line| line.split("](").skip(1));
    starts.filter_map(|rest| rest.split([')', ' ']).next()).map(str::to_owned).collect()
}

/// A line without inline code, which stands between backticks.
fn without_code(line: &str) -> String {
    line.split('`').step_by(2).collect::<Vec<_>>().join("`")
}

/// The anchors of a document's headings, as repository hosts such as GitHub make them. A repeated heading gets a
/// number.
fn anchors(document: &str) -> Vec<String> {
    let mut seen: HashMap<String, usize> = HashMap::new();
    let headings =
        lines(document).into_iter().filter(|(language, line)| language.is_none() && line.starts_with('#'));
    headings
        .map(|(_, line)| {
            let slug = slug(line.trim_start_matches('#').trim());
            let count = seen.entry(slug.clone()).or_insert(0);
            *count += 1;
            if *count == 1 { slug } else { format!("{slug}-{}", *count - 1) }
        })
        .collect()
}

/// The anchor of a heading: in lower case, with words joined by hyphens, without punctuation. A link counts as its
/// text.
fn slug(heading: &str) -> String {
    let links = heading.split("](").enumerate();
    let text =
        links.map(|(i, part)| if i == 0 { part } else { part.split_once(')').map_or("", |(_, rest)| rest) });
    let signs = text.collect::<String>().to_lowercase();
    let kept = signs.chars().filter(|sign| sign.is_alphanumeric() || ['-', '_', ' '].contains(sign));
    kept.map(|sign| if sign == ' ' { '-' } else { sign }).collect()
}

/// What is wrong with a link in the document `file`; `None` if its target exists or is on another site.
fn fault(file: &Path, target: &str, read: impl Fn(&Path) -> Option<String>) -> Option<String> {
    if target.contains("://") || target.starts_with("mailto:") {
        return None;
    }
    let (path, anchor) = target.split_once('#').map_or((target, None), |(path, anchor)| (path, Some(anchor)));
    let to: PathBuf = if path.is_empty() { file.into() } else { file.parent()?.join(path) };
    match (read(&to), anchor) {
        (None, _) => Some(format!("{}: {target} is not there", file.display())),
        (Some(text), Some(anchor)) if !anchors(&text).iter().any(|known| known == anchor) => {
            Some(format!("{}: {target} has no such heading", file.display()))
        }
        _ => None,
    }
}

#[test]
fn every_link_leads_somewhere() {
    // Folders and pictures cannot be read as text: they have no headings, so an empty text stands for them.
    let read = |path: &Path| path.exists().then(|| std::fs::read_to_string(path).unwrap_or_default());
    let mut faults = Vec::new();
    for document in documents() {
        let file = root().join(document);
        let text = read(&file).unwrap();
        faults.extend(targets(&text).iter().filter_map(|target| fault(&file, target, read)));
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn dead_links_are_found() {
    let text = "# A `b`: [c](d.md)!\n## Words\n## Words\n[x](e.md#words) ![p](p.jpg \"title\") `[no](link)`\n```\n[no](code)\n```\n";
    assert_eq!(targets(text), ["d.md", "e.md#words", "p.jpg"]);
    assert_eq!(anchors(text), ["a-b-c", "words", "words-1"]);
    let read = |path: &Path| path.ends_with("e.md").then(|| text.to_owned());
    let is_dead = |target: &str| fault(Path::new("docs/e.md"), target, read).is_some();
    for target in ["e.md", "#words-1", "e.md#a-b-c", "https://example.org/gone"] {
        assert!(!is_dead(target), "{target}");
    }
    for target in ["gone.md", "#gone", "e.md#words-2"] {
        assert!(is_dead(target), "{target}");
    }
}
