//! Writes and checks the tables of documents. A table stands between two markers, the first of which names the
//! results:
//!
//! ```text
//! <!-- results: passes -->
//! … the table of `passes.json` …
//! <!-- end of results -->
//! ```

use std::collections::BTreeSet;
use std::fs;
use std::io;

use super::record::Results;
use super::{machine, store};

/// The document that must show all results.
pub const ALL: &str = "shared/docs/RESULTS.md";
/// The documents whose tables [`write_all`] writes.
pub const DOCUMENTS: [&str; 2] = [ALL, "README.md"];

const BEGIN: &str = "<!-- results: ";
const END: &str = "<!-- end of results -->";

/// Replaces the tables of all documents by the tables of the stored results.
pub fn write_all() -> io::Result<()> {
    for (document, text) in texts()? {
        let new = with_tables(&text, stored)?;
        if new != text {
            fs::write(machine::root().join(document), new)?;
        }
    }
    Ok(())
}

/// The faults of the documents, a sentence for each. A fault is a marker without stored results, or a document
/// whose tables differ from the stored results. In [`ALL`], tables outside markers and results that are not shown
/// are faults too.
pub fn faults() -> io::Result<Vec<String>> {
    let mut faults = Vec::new();
    let names = BTreeSet::from_iter(store::names(&store::folder())?);
    for (document, text) in texts()? {
        let unknown = |name: &str| format!("{document}: there are no results `{name}`; measure them");
        faults.extend(shown(&text).difference(&names).map(|name| unknown(name)));
        if with_tables(&text, stored)? != text {
            faults.push(format!("{document}: a table differs from its results; `results` writes it anew"));
        }
        if document == ALL {
            let by_hand = |line: &str| format!("{document}: a table that no results give: {line}");
            faults.extend(unmarked_tables(&text).map(by_hand));
            let shown = shown(&text);
            let missing = names.iter().filter(|name| !shown.contains(*name));
            faults.extend(missing.map(|name| format!("{document}: the results `{name}` are not shown")));
        }
    }
    Ok(faults)
}

fn texts() -> io::Result<Vec<(&'static str, String)>> {
    DOCUMENTS
        .into_iter()
        .map(|document| Ok((document, fs::read_to_string(machine::root().join(document))?)))
        .collect()
}

fn stored(name: &str) -> io::Result<Option<Results>> {
    store::read(&store::folder(), name)
}

/// The text with every table between markers replaced by that of its results; by nothing if there are no results.
/// Fails if a marker has no end.
fn with_tables(
    text: &str,
    mut results: impl FnMut(&str) -> io::Result<Option<Results>>,
) -> io::Result<String> {
    let mut new = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once(BEGIN) {
        let unclosed = || io::Error::other(format!("`{BEGIN}` without `{END}`"));
        let (name, after) = after.split_once(" -->\n").ok_or_else(unclosed)?;
        let (_, after) = after.split_once(END).ok_or_else(unclosed)?;
        let table = results(name)?.map_or_else(String::new, |results| results.to_markdown());
        new += &format!("{before}{BEGIN}{name} -->\n{table}{END}");
        rest = after;
    }
    Ok(new + rest)
}

/// The names of the results that a text shows.
fn shown(text: &str) -> BTreeSet<String> {
    let names = text.lines().filter_map(|line| line.strip_prefix(BEGIN)?.strip_suffix(" -->"));
    names.map(str::to_owned).collect()
}

/// The first line of each table that is not between markers.
fn unmarked_tables(text: &str) -> impl Iterator<Item = &str> {
    let mut is_marked = false;
    let mut was_table = false;
    text.lines().filter(move |line| {
        is_marked = (is_marked || line.starts_with(BEGIN)) && !line.starts_with(END);
        let is_table = line.starts_with('|');
        let is_first = is_table && !was_table;
        was_table = is_table;
        is_first && !is_marked
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::{Column, Row};

    fn passes(name: &str) -> io::Result<Option<Results>> {
        Ok((name != "none").then(|| Results {
            name: name.to_owned(),
            source: None,
            commit: "1234567".to_owned(),
            date: "2026-11-22".to_owned(),
            processor: "P".to_owned(),
            cores: 2,
            command: "cargo bench".to_owned(),
            columns: vec![Column::splats()],
            rows: vec![Row { name: name.to_owned(), values: vec![Some(1.0)] }],
        }))
    }

    #[test]
    fn tables_are_replaced_and_prose_stays() {
        let text = "Prose.\n\n<!-- results: a -->\nold\n<!-- end of results -->\n\nMore.\n<!-- results: b -->\n<!-- end of results -->\n";
        let new = with_tables(text, passes).unwrap();
        let table = |name| {
            format!(
                "| | splats |\n|---|---:|\n| {name} | 1 |\n\n`cargo bench`: 2026-11-22, commit 1234567, 2 cores of P.\n"
            )
        };
        let marked = |name| format!("<!-- results: {name} -->\n{}<!-- end of results -->\n", table(name));
        assert_eq!(new, format!("Prose.\n\n{}\nMore.\n{}", marked("a"), marked("b")));
        assert_eq!(with_tables(&new, passes).unwrap(), new, "written again, it stays");
        assert_eq!(shown(&new), BTreeSet::from(["a", "b"].map(str::to_owned)));
        let by_hand = new.replace("| a | 1 |", "| a | 2 |");
        assert_ne!(with_tables(&by_hand, passes).unwrap(), by_hand, "a figure typed by hand is noticed");
        assert!(with_tables("<!-- results: a -->\n", passes).is_err());
        let empty = "<!-- results: none -->\n<!-- end of results -->\n";
        assert_eq!(with_tables(empty, passes).unwrap(), empty);
    }

    #[test]
    fn tables_outside_markers_are_found() {
        let text = "| a |\n|---|\n\n<!-- results: x -->\n| b |\n<!-- end of results -->\n| c |\n";
        assert_eq!(unmarked_tables(text).collect::<Vec<_>>(), ["| a |", "| c |"]);
    }
}
