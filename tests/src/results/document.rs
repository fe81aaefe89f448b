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
use super::{machine, provenance, store};

/// The document that must show all results.
pub const ALL: &str = "shared/docs/RESULTS.md";
/// The documents whose tables [`write_all`] writes.
pub const DOCUMENTS: [&str; 3] = [ALL, "README.md", "shared/docs/TESTING.md"];

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

/// The faults of the stored results and of the documents, a sentence for each.
///
/// A fault of results is a source, unless `results` cannot measure them, or a commit that cannot be checked out. A
/// fault of a document is a marker without stored results, a table that differs from its results, or a table of
/// figures outside markers. In [`ALL`], any table outside markers and results that are not shown are faults too.
pub fn faults() -> io::Result<Vec<String>> {
    let all = store::read_all(&store::folder())?;
    let of_results = all.iter().flat_map(|results| provenance::faults(results, machine::has_commit));
    let mut faults: Vec<String> = of_results.collect();
    let names = all.into_iter().map(|results| results.name).collect();
    for (document, text) in texts()? {
        faults.extend(faults_of(document, &text, &names)?);
    }
    Ok(faults)
}

/// The faults of a document. `names` are the names of all stored results.
fn faults_of(document: &str, text: &str, names: &BTreeSet<String>) -> io::Result<Vec<String>> {
    let shown = shown(text);
    let unknown = |name: &String| format!("{document}: there are no results `{name}`; measure them");
    let mut faults: Vec<String> = shown.difference(names).map(unknown).collect();
    if with_tables(text, stored)? != text {
        faults.push(format!("{document}: a table differs from its results; `results` writes it anew"));
    }
    let by_hand = unmarked_tables(text).into_iter().filter(|table| document == ALL || has_figures(table));
    faults.extend(by_hand.map(|table| format!("{document}: a table that no results give: {}", table[0])));
    if document == ALL {
        let missing = names.difference(&shown);
        faults.extend(missing.map(|name| format!("{document}: the results `{name}` are not shown")));
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

/// The lines of a text that are not between markers.
pub fn unmarked(text: &str) -> impl Iterator<Item = &str> {
    let mut is_marked = false;
    text.lines().filter(move |line| {
        is_marked = (is_marked || line.starts_with(BEGIN)) && !line.starts_with(END);
        !is_marked
    })
}

/// The tables that are not between markers, each as its lines.
fn unmarked_tables(text: &str) -> Vec<Vec<&str>> {
    let lines: Vec<&str> = unmarked(text).filter(|line| !line.starts_with("<!--")).collect();
    let is_blank = |line: &str| line.trim().is_empty();
    // In Markdown, an HTML table needs no blank line before it.
    let paragraphs = lines.chunk_by(|a, b| is_blank(a) == is_blank(b) && !is_html_table(b));
    paragraphs.flat_map(tables_in).map(<[&str]>::to_vec).collect()
}

/// The tables in a paragraph. An HTML table and a table with a rule take up the whole paragraph. Without a rule, the
/// lines that start with a bar are tables.
fn tables_in<'a, 'text>(paragraph: &'a [&'text str]) -> Vec<&'a [&'text str]> {
    if is_html_table(paragraph[0]) || paragraph.iter().any(|line| is_rule(line)) {
        return vec![paragraph];
    }
    let has_bar = |line: &str| line.trim_start().starts_with('|');
    let blocks = paragraph.chunk_by(|a, b| has_bar(a) == has_bar(b));
    blocks.filter(|block| has_bar(block[0])).collect()
}

/// Whether a line is the rule below the head of a table, such as `--- | ---:`.
fn is_rule(line: &str) -> bool {
    line.contains('-') && line.contains('|') && line.chars().all(|sign| " |-:".contains(sign))
}

/// Whether an HTML table starts at the beginning of a line.
fn is_html_table(line: &str) -> bool {
    line.trim_start().starts_with("<table")
}

/// Whether a table shows figures: a digit below the two lines of its head, or anywhere in an HTML table. Inline code
/// does not count, since it holds names such as `points3D`.
fn has_figures(table: &[&str]) -> bool {
    let head = if is_html_table(table[0]) { 0 } else { 2 };
    let mut prose = table.iter().skip(head).flat_map(|row| row.split('`').step_by(2));
    prose.any(|text| text.contains(|sign: char| sign.is_ascii_digit()))
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
        assert_eq!(unmarked_tables(text), [vec!["| a |", "|---|"], vec!["| c |"]]);
        for other in ["  | a |", "a | b\n--- | ---:\n1 | 2", "<table><tr><td>1</td></tr></table>"] {
            assert_eq!(unmarked_tables(other).len(), 1, "{other}");
        }
        assert!(unmarked_tables("- a\n--\nb | c\n").is_empty());
    }

    #[test]
    fn tables_of_figures_are_told_from_tables_of_words() {
        assert!(has_figures(&["| | PSNR, dB |", "|---|---:|", "| city | 24.09 |"]));
        assert!(!has_figures(&["| 2D | 3D |", "|---|---|", "| a | export `points3D` |"]));
    }

    #[test]
    fn a_document_with_faults_is_found() {
        let figures = "| a |\n|---|\n| 1 |\n";
        let words = "| a |\n|---|\n| b |\n";
        let no_results = "<!-- results: no such bench -->\n<!-- end of results -->\n";
        let names = BTreeSet::from(["hidden".to_owned()]);
        let count = |document, text: &str| faults_of(document, text, &names).unwrap().len();
        assert_eq!(count("README.md", words), 0);
        assert_eq!(count("README.md", figures), 1, "figures without markers");
        for table in [
            "a | b\n--- | ---:\nx | 1\n",
            "<table>\n<tr><td>1</td></tr>\n</table>\n",
            "Prose:\n<table>1</table>",
        ] {
            assert_eq!(count("README.md", table), 1, "{table}");
            assert_eq!(count("README.md", &table.replace('1', "w")), 0, "{table}");
        }
        assert_eq!(count("README.md", no_results), 1, "a marker without results");
        assert_eq!(count(ALL, words), 2, "a table without markers, and results that are not shown");
    }
}
