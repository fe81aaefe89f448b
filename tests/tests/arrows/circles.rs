//! No import circle between the modules of a crate.
//!
//! **The rule.** A module *uses* another if its code names something that the other defines, in a `use` declaration or in
//! a path. Re-exports are looked through: what counts is where a name is defined. A module that re-exports names of its
//! own descendants does not use them by that alone, so `pub use child::Thing;` in a parent is free.
//!
//! Every module is looked at together with its children, where a child stands for its whole subtree: neither the children
//! among each other nor the module's own code with its children may use each other in a circle. So two folders cannot use
//! each other, through whichever of their files; and a child that uses its parent's items while the parent uses the child
//! is a circle. Declaring a child (`mod child;`) and calling methods of its types is not a use.
//!
//! **Mending a circle.** Move what both sides need into a module that both use: a further child, or one beside them.
//! `cargo test --release -p cosurf-tests --test arrows` lists every circle.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::modules::{self, Module};
use crate::names::{Named, resolve};
use crate::{members, root};

/// A use of one module by another: the indices, and the path by which it is named.
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

/// A module and those above it, up to the root.
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

/// The circles of a crate, each as the uses that close it.
fn circles(modules: &[Module]) -> Vec<String> {
    // For each module: which of its children use which, and by which path.
    let mut arrows: BTreeMap<usize, BTreeMap<(usize, usize), String>> = BTreeMap::new();
    for Use { from, to, path } in uses(modules) {
        let (top, a, b) = meeting(modules, from, to);
        let words = format!("{} uses `{path}`", name(modules, from));
        arrows.entry(top).or_default().entry((a, b)).or_insert(words);
    }
    arrows.values().flat_map(circles_among).collect()
}

/// The circles among nodes that are joined by arrows: each set of nodes that all reach each other.
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

/// The roots of a crate's library, programs, tests, benches and examples.
fn target_roots(folder: &Path) -> Vec<PathBuf> {
    let mut roots: Vec<_> = ["src/lib.rs", "src/main.rs"].map(|file| folder.join(file)).into();
    for kind in ["src/bin", "tests", "benches", "examples"] {
        let Ok(entries) = folder.join(kind).read_dir() else { continue };
        for path in entries.map(|entry| entry.unwrap().path()) {
            roots.push(if path.is_dir() { path.join("main.rs") } else { path });
        }
    }
    roots.retain(|path| path.is_file() && path.extension().is_some_and(|extension| extension == "rs"));
    roots
}

#[test]
fn modules_do_not_use_each_other_in_circles() {
    let mut found = Vec::new();
    for member in members() {
        let in_target = |file: &PathBuf| circles(&modules::read(file));
        let circles = target_roots(&root().join(&member)).iter().flat_map(in_target).collect::<Vec<_>>();
        found.extend(circles.iter().map(|circle| format!("{member}: {circle}")));
    }
    assert!(found.is_empty(), "{} circles:\n{}", found.len(), found.join("\n"));
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
