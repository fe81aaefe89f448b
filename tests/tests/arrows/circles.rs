//! Checks that the modules of a crate do not depend on each other in a circle.
//!
//! **The rule.** A module *uses* another module if its code names an item that the other module defines, in a `use`
//! declaration or in a path. If the name is re-exported, the module that defines the item counts, not the one that
//! re-exports it. A re-export of items of a module's own descendants is not a use, so `pub use child::Thing;` in a
//! parent is allowed.
//!
//! The test takes each module together with its children, and each child stands for its whole subtree. The children
//! and the module's own code must not use each other in a circle. Two folders must therefore not use each other,
//! whichever of their files do so. And if a parent uses an item of its child, the child must not use items of the
//! parent. Declaring a child (`mod child;`) and calling methods of its types are not uses.
//!
//! **Mending a circle.** Move the items that both sides need into a third module that both use: a further child, or a
//! module beside them. `cargo test --release -p cosurf-tests --test arrows` lists every circle.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::modules::{self, Module};
use crate::names::{Named, resolve};
use crate::{manifest, members, root};

/// A use of module `to` by module `from`: the indices of both, and the path in the code of `from` that names an item
/// of `to`.
struct Use {
    from: usize,
    to: usize,
    path: String,
}

fn uses(modules: &[Module]) -> Vec<Use> {
    let mut uses = Vec::new();
    for (from, module) in modules.iter().enumerate() {
        let is_below = |to: usize| ancestors(modules, to).any(|ancestor| ancestor == from);
        let mut add = |path: &[String], is_reexport: bool, is_glob: bool| {
            let to = match resolve(modules, from, path) {
                Some(Named::ItemOf(to)) => to,
                Some(Named::Module(to)) if is_glob => to,
                _ => return,
            };
            if to != from && !(is_reexport && is_below(to)) {
                uses.push(Use { from, to, path: path.join("::") });
            }
        };
        module.imports.iter().for_each(|import| add(&import.path, import.is_reexport, import.name.is_none()));
        module.paths.iter().for_each(|path| add(path, false, false));
    }
    uses
}

/// A module, its parent, and so on up to the root.
fn ancestors(modules: &[Module], module: usize) -> impl Iterator<Item = usize> {
    std::iter::successors(Some(module), |&module| modules[module].parent)
}

/// The nearest module that contains both `a` and `b`, then its child that contains `a` and its child that
/// contains `b`. If `a` or `b` is that nearest module, the module itself takes the place of the child.
fn meeting(modules: &[Module], a: usize, b: usize) -> (usize, usize, usize) {
    let above: Vec<usize> = ancestors(modules, a).collect();
    let top = ancestors(modules, b).find(|module| above.contains(module)).unwrap();
    let child = |of| ancestors(modules, of).take_while(|module| *module != top).last().unwrap_or(top);
    (top, child(a), child(b))
}

/// The circles of a crate. Each is described by the uses that form it.
fn circles(modules: &[Module]) -> Vec<String> {
    // For each module: the pairs of its children of which the first uses the second, and a description of the use.
    let mut arrows: BTreeMap<usize, BTreeMap<(usize, usize), String>> = BTreeMap::new();
    for Use { from, to, path } in uses(modules) {
        let (top, a, b) = meeting(modules, from, to);
        let words = format!("{} uses `{path}`", name(modules, from));
        arrows.entry(top).or_default().entry((a, b)).or_insert(words);
    }
    arrows.values().flat_map(circles_among).collect()
}

/// The circles of a graph. Each set of nodes that all reach each other counts as one circle, described by its arrows.
/// The keys of `arrows` are (from, to), the values their descriptions.
fn circles_among(arrows: &BTreeMap<(usize, usize), String>) -> Vec<String> {
    let nodes: BTreeSet<usize> = arrows.keys().flat_map(|(a, b)| [*a, *b]).collect();
    let reach: BTreeMap<usize, BTreeSet<usize>> =
        nodes.iter().map(|node| (*node, reached_from(*node, arrows))).collect();
    let mut sets: Vec<BTreeSet<usize>> = Vec::new();
    for node in nodes.iter().filter(|node| reach[node].contains(node)) {
        let set = reach[node].iter().copied().filter(|other| reach[other].contains(node)).collect();
        if !sets.contains(&set) {
            sets.push(set);
        }
    }
    let within = |set: &BTreeSet<usize>| {
        let inner = arrows.iter().filter(|((a, b), _)| set.contains(a) && set.contains(b));
        inner.map(|(_, words)| words.as_str()).collect::<Vec<_>>().join("; ")
    };
    sets.iter().map(within).collect()
}

fn reached_from(node: usize, arrows: &BTreeMap<(usize, usize), String>) -> BTreeSet<usize> {
    let mut reached = BTreeSet::new();
    let mut open = vec![node];
    while let Some(node) = open.pop() {
        let next = arrows.keys().filter(|(from, _)| *from == node).map(|(_, to)| *to);
        open.extend(next.filter(|to| reached.insert(*to)));
    }
    reached
}

fn name(modules: &[Module], module: usize) -> &str {
    let path = modules[module].path.as_str();
    if path.is_empty() { "the root" } else { path }
}

/// The root files that a manifest names, relative to its folder.
fn named_roots(manifest: &toml::Table) -> impl Iterator<Item = &str> {
    let kinds = ["lib", "bin", "test", "bench", "example"].into_iter();
    let kinds = kinds.filter_map(move |kind| manifest.get(kind));
    let targets = kinds.flat_map(|kind| kind.as_array().map_or(std::slice::from_ref(kind), Vec::as_slice));
    targets.filter_map(|target| target.get("path")?.as_str())
}

/// The root files of a crate's library, programs, tests, benches and examples: those that its manifest names, and
/// those at cargo's default places.
fn target_roots(member: &str) -> BTreeSet<PathBuf> {
    let folder = root().join(member);
    let mut roots: Vec<PathBuf> = ["src/lib.rs", "src/main.rs"].map(|file| folder.join(file)).into();
    for kind in ["src/bin", "tests", "benches", "examples"] {
        let Ok(entries) = folder.join(kind).read_dir() else { continue };
        for path in entries.map(|entry| entry.unwrap().path()) {
            roots.push(if path.is_dir() { path.join("main.rs") } else { path });
        }
    }
    roots.retain(|path| path.is_file() && path.extension().is_some_and(|extension| extension == "rs"));
    roots.extend(named_roots(&manifest(member)).map(|file| folder.join(file)));
    roots.into_iter().collect()
}

#[test]
fn modules_do_not_use_each_other_in_circles() {
    let mut found = Vec::new();
    for member in members() {
        let roots = target_roots(&member);
        assert!(!roots.is_empty(), "{member} has no modules");
        let circles = roots.iter().flat_map(|file| circles(&modules::read(file)));
        found.extend(circles.map(|circle| format!("{member}: {circle}")));
    }
    assert!(found.is_empty(), "{} circles:\n{}", found.len(), found.join("\n"));
}

#[test]
fn roots_that_a_manifest_names_are_read() {
    let manifest = "lib.path = \"l.rs\"\n[[bin]]\nname = \"b\"\n[[bench]]\npath = \"c.rs\"\n";
    let manifest: toml::Table = manifest.parse().unwrap();
    assert_eq!(named_roots(&manifest).collect::<Vec<_>>(), ["l.rs", "c.rs"]);
    assert!(target_roots("shaders").contains(&root().join("shaders/lib.rs")));
}

fn circles_of(text: &str) -> Vec<String> {
    circles(&modules::modules_of(text, Path::new("")))
}

#[test]
fn circles_are_found() {
    for (kind, text) in [
        ("siblings", "mod a { use super::b::B; } mod b { pub struct B; fn f() -> crate::a::A {} }"),
        (
            "by way of a third",
            "mod a { use crate::b::B; } mod b { use crate::c::C; } mod c { use crate::a::A; }",
        ),
        ("a child and its parent", "mod p { use c::C; mod c { use super::P; struct C; } struct P; }"),
        (
            "folders",
            "mod a { mod x { use crate::b::y::Y; } mod z { struct Z; } } \
                     mod b { mod y { struct Y; } mod w { use crate::a::z::Z; } }",
        ),
        (
            "a macro's arguments",
            "mod a { fn f() { print!(\"{}\", crate::b::N) } } mod b { use crate::a::f; const N: u8; }",
        ),
        (
            "through a re-export",
            "pub use a::A; mod a { use crate::b::B; struct A; } mod b { use crate::A; struct B; }",
        ),
        ("of all names", "mod a { use super::b::*; struct A; } mod b { use super::a::A; struct B; }"),
    ] {
        assert_eq!(circles_of(text).len(), 1, "{kind}: {:?}", circles_of(text));
    }
}

#[test]
fn what_is_no_circle_is_not_found() {
    for (kind, text) in [
        ("one way", "mod a { use super::b::B; } mod b { pub struct B; }"),
        ("a parent that only declares", "mod p { mod c { use super::P; } struct P; }"),
        (
            "a parent that only re-exports",
            "mod p { pub use c::C; mod c { use super::P; struct C; } struct P; }",
        ),
        ("a sibling by the parent's re-export", "pub use a::A; mod a { struct A; } mod b { use super::A; }"),
        (
            "tests",
            "mod a { use super::b::B; struct A; } mod b { struct B; #[cfg(test)] mod tests { use crate::a::A; } }",
        ),
        ("other crates", "mod a { use b::B; fn f() { b::f() } } mod c { use crate::a::A; }"),
    ] {
        assert_eq!(circles_of(text), [""; 0], "{kind}");
    }
}
