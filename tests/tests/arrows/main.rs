//! Checks the dependencies between crates, as the manifests state them, and between modules, as the sources show
//! them. Also checks that no closure calls an intrinsic.
#![allow(clippy::unwrap_used)]

mod circles;
mod crates;
mod intrinsics;
mod modules;
mod names;

use std::fs;
use std::path::{Path, PathBuf};

/// The root of the workspace.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// The parsed `Cargo.toml` of a folder below the root.
fn manifest(folder: &str) -> toml::Table {
    fs::read_to_string(root().join(folder).join("Cargo.toml")).unwrap().parse().unwrap()
}

/// The folders of the workspace's crates, sorted.
fn members() -> Vec<String> {
    let manifest = manifest("");
    let members = manifest["workspace"]["members"].as_array().unwrap();
    let mut members: Vec<String> = members.iter().map(|member| member.as_str().unwrap().to_owned()).collect();
    members.sort_unstable();
    members
}
