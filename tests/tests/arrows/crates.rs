//! Checks that the dependencies between crates are those that `shared/docs/ARCHITECTURE.md` lists. Further tests
//! check rules for single crates.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use crate::{manifest, members, root};

/// The crates of the workspace, and for each crate the crates of the workspace that it depends on. A crate is named
/// by the last part of its folder.
type Arrows = BTreeMap<String, BTreeSet<String>>;

/// The dependencies that a document lists, in its code block marked `arrows`. A line is, for example,
/// `link ► scene wire`.
fn drawn(document: &str) -> Arrows {
    let (_, block) = document.split_once("\n```arrows\n").expect("a block of code marked `arrows`");
    let (block, _) = block.split_once("```").unwrap();
    let line = |line: &str| {
        let (from, to) = line.split_once('►').expect("an arrow in each line");
        (from.trim().to_owned(), to.split_whitespace().map(str::to_owned).collect())
    };
    block.lines().map(line).collect()
}

fn short_name(folder: &str) -> String {
    folder.rsplit('/').next().unwrap().to_owned()
}

/// The names in the `[dependencies]` of a manifest, including those for single platforms. Dependencies of tests and
/// of build scripts do not count.
fn dependencies(manifest: &toml::Table) -> Vec<String> {
    let tables = manifest.get("target").and_then(|target| target.as_table());
    let tables = tables.into_iter().flat_map(toml::Table::values).filter_map(|table| table.as_table());
    let lists =
        std::iter::once(manifest).chain(tables).filter_map(|table| table.get("dependencies")?.as_table());
    lists.flat_map(|list| list.keys().cloned()).collect()
}

/// The dependencies between crates that these manifests state. Each manifest comes with its folder.
fn built<'a>(manifests: impl Iterator<Item = (&'a str, toml::Table)>) -> Arrows {
    let arrow = |(folder, manifest): (&str, toml::Table)| {
        let found = dependencies(&manifest);
        let ours = found.iter().filter_map(|name| name.strip_prefix("cosurf-")).map(str::to_owned).collect();
        (short_name(folder), ours)
    };
    manifests.map(arrow).collect()
}

#[test]
fn arrows_are_those_of_the_document() {
    let members = members();
    let built = built(members.iter().map(|folder| (folder.as_str(), manifest(folder))));
    let document = fs::read_to_string(root().join("shared/docs/ARCHITECTURE.md")).unwrap();
    assert_eq!(drawn(&document), built, "left: ARCHITECTURE.md, right: the manifests");
}

#[test]
fn arrows_too_many_and_too_few_are_found() {
    let document = "\n```arrows\na ► b\nb ►\n```\n";
    let built_of = |a: &str, b: &str| {
        let manifest = |of: &str| format!("[dependencies]\nglam = \"1\"\n{of}").parse().unwrap();
        built([("x/a", manifest(a)), ("b", manifest(b))].into_iter())
    };
    let arrow = "cosurf-b = { workspace = true }";
    assert_eq!(built_of(arrow, ""), drawn(document));
    assert_ne!(built_of("", ""), drawn(document), "too few");
    assert_ne!(built_of(arrow, "cosurf-a = { workspace = true }"), drawn(document), "too many");
    let on_unix = format!("[target.'cfg(unix)'.dependencies]\n{arrow}");
    assert_eq!(built_of(&on_unix, ""), drawn(document), "of one platform");
}

/// Libraries for neural networks are needed for evaluation (LPIPS), which happens on the ground. A drone's program
/// must not link them.
#[test]
fn only_the_aggregator_depends_on_neural_networks() {
    for folder in members() {
        let found = dependencies(&manifest(&folder));
        let has = ["ndarray", "safetensors"].map(|network| found.iter().any(|name| name == network));
        assert_eq!(has, [folder == "aggregator"; 2], "{folder}");
    }
}

#[test]
fn every_crate_is_on_the_readmes_map() {
    let readme = fs::read_to_string(root().join("README.md")).unwrap();
    for member in members() {
        let is_on_it = readme.lines().any(|line| line.split_whitespace().next() == Some(member.as_str()));
        assert!(is_on_it, "{member} is not on the README's map");
    }
}

/// Cargo packages the files in a crate's folder and follows links, so a link to each licence is enough.
#[test]
fn every_package_contains_the_licences() {
    let is_packaged = |folder: &String| {
        manifest(folder)["package"].get("publish").and_then(toml::Value::as_bool) != Some(false)
    };
    for folder in members().into_iter().filter(is_packaged) {
        for (name, licence) in [("LICENSE-MIT", "MIT.txt"), ("LICENSE-APACHE", "Apache-2.0.txt")] {
            let text = fs::read_to_string(root().join("shared/licenses").join(licence)).unwrap();
            let found = fs::read_to_string(root().join(&folder).join(name));
            assert!(found.is_ok_and(|found| found == text), "{folder}/{name} is not {licence}");
        }
    }
}

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// The shared crates take the time as an argument and read no clocks. `shared/link` is exempt, because its transports
/// need clocks, and `shared/cli`, which checks the clock and the disk of a computer.
#[test]
fn shared_crates_read_no_clocks() {
    let is_exempt = |folder: &str| ["shared/cli", "shared/link"].contains(&folder);
    for folder in members().iter().filter(|folder| folder.starts_with("shared/") && !is_exempt(folder)) {
        let mut files = Vec::new();
        sources(&root().join(folder).join("src"), &mut files);
        assert!(!files.is_empty(), "{folder}");
        for file in files {
            let text = fs::read_to_string(&file).unwrap();
            for clock in ["Instant::now", "SystemTime::now"] {
                assert!(!text.contains(clock), "{} reads a clock", file.display());
            }
        }
    }
}

#[test]
fn the_wire_needs_no_standard_library() {
    let text = fs::read_to_string(root().join("shared/wire/src/lib.rs")).unwrap();
    assert!(text.contains("#![no_std]") && !text.contains("extern crate alloc"));
}
