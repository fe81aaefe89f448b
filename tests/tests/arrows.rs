//! Who may know whom: the arrows of the README, read from the manifests and the sources themselves.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};

/// Every crate, its folder, and the crates of ours that it may depend on.
const ARROWS: [(&str, &str, &[&str]); 9] = [
    ("cosurf-scene", "shared/scene", &[]),
    ("cosurf-city", "shared/city", &["cosurf-scene"]),
    ("cosurf-wire", "shared/wire", &["cosurf-scene"]),
    ("cosurf-link", "shared/link", &["cosurf-scene", "cosurf-wire"]),
    ("cosurf-shaders", "shaders", &[]),
    ("cosurf-engine", "shared/engine", &["cosurf-scene", "cosurf-shaders"]),
    ("cosurf-contract", "shared/contract", &["cosurf-engine", "cosurf-link", "cosurf-wire"]),
    (
        "cosurf-agent",
        "agent",
        &["cosurf-contract", "cosurf-engine", "cosurf-link", "cosurf-scene", "cosurf-wire"],
    ),
    (
        "cosurf-aggregator",
        "aggregator",
        &["cosurf-city", "cosurf-contract", "cosurf-engine", "cosurf-link", "cosurf-scene", "cosurf-wire"],
    ),
];

/// Folders whose sources may not read a clock: time comes in as an argument, or not at all.
const CLOCKLESS: [&str; 5] =
    ["shared/scene/src", "shared/city/src", "shared/contract/src", "shared/wire/src", "shared/engine/src"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// Names below `[dependencies]` of a manifest; those of tests do not count.
fn dependencies(manifest: &str) -> Vec<String> {
    let manifest: toml::Table = manifest.parse().unwrap();
    manifest["dependencies"].as_table().unwrap().keys().cloned().collect()
}

/// The dependencies among `found` that are ours and not allowed.
fn forbidden<'a>(found: &'a [String], allowed: &[&str]) -> Vec<&'a str> {
    let ours = found.iter().map(String::as_str).filter(|name| name.starts_with("cosurf-"));
    ours.filter(|name| !allowed.contains(name)).collect()
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

#[test]
fn crates_know_only_whom_they_may() {
    for (name, folder, allowed) in ARROWS {
        let manifest = fs::read_to_string(root().join(folder).join("Cargo.toml")).unwrap();
        let found = dependencies(&manifest);
        assert_eq!(forbidden(&found, allowed), [""; 0], "{name}");
    }
    // The comparison sees an arrow that must not be.
    let found = dependencies("[dependencies]\ncosurf-aggregator = { workspace = true }\nglam = \"1\"\n");
    assert_eq!(forbidden(&found, ARROWS[6].2), ["cosurf-aggregator"]);
}

/// What measures with neural networks is for the ground: a drone's computer does not carry it.
#[test]
fn networks_stay_in_the_aggregator() {
    for (name, folder, _) in ARROWS {
        let manifest = fs::read_to_string(root().join(folder).join("Cargo.toml")).unwrap();
        let found = dependencies(&manifest);
        let has = ["ndarray", "safetensors"].map(|network| found.iter().any(|name| name == network));
        assert_eq!(has, [name == "cosurf-aggregator"; 2], "{name}");
    }
}

#[test]
fn every_crate_is_on_the_map() {
    let manifest: toml::Table = fs::read_to_string(root().join("Cargo.toml")).unwrap().parse().unwrap();
    let members: Vec<&str> =
        manifest["workspace"]["members"].as_array().unwrap().iter().map(|m| m.as_str().unwrap()).collect();
    let mut mapped: Vec<&str> = ARROWS.iter().map(|(_, folder, _)| *folder).chain(["tests"]).collect();
    let mut sorted = members.clone();
    sorted.sort_unstable();
    mapped.sort_unstable();
    assert_eq!(sorted, mapped);
    let readme = fs::read_to_string(root().join("README.md")).unwrap();
    for member in members {
        assert!(
            readme.lines().any(|line| line.split_whitespace().next() == Some(member)),
            "{member} is not in the README's map"
        );
    }
}

#[test]
fn only_programs_and_sockets_read_clocks() {
    for folder in CLOCKLESS {
        let mut files = Vec::new();
        sources(&root().join(folder), &mut files);
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
