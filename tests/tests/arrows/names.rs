//! Which module defines what a path names.

use crate::modules::Module;

/// More re-exports than this in a row are a circle of names.
const DEPTH_MAX: usize = 16;

/// What a path names, by the index of a module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Named {
    /// Something that the module defines.
    ItemOf(usize),
    /// The module itself.
    Module(usize),
}

/// What `path`, written in module `from`, names; `None` for names of other crates and of local variables.
pub(crate) fn resolve(modules: &[Module], from: usize, path: &[String]) -> Option<Named> {
    resolve_within(modules, from, path, 0)
}

fn resolve_within(modules: &[Module], from: usize, path: &[String], depth: usize) -> Option<Named> {
    if depth > DEPTH_MAX {
        return None;
    }
    let mut rest = path;
    let mut at = from;
    let mut is_rooted = false;
    while let Some((first, others)) = rest.split_first() {
        at = match first.as_str() {
            "crate" => 0,
            "self" => at,
            "super" => modules[at].parent?,
            _ => break,
        };
        (rest, is_rooted) = (others, true);
    }
    while let Some((name, others)) = rest.split_first() {
        match look_up(modules, at, name, !others.is_empty(), depth) {
            Some(Named::Module(module)) => at = module,
            Some(item) => return Some(item),
            // A name that a macro defines, or one of another crate that the module hands on.
            None if is_rooted => return Some(Named::ItemOf(at)),
            None => return None,
        }
        (rest, is_rooted) = (others, true);
    }
    is_rooted.then_some(Named::Module(at))
}

/// What `name` means in a module. Where it is both a module and a function, `is_prefix` tells which is meant.
fn look_up(modules: &[Module], at: usize, name: &str, is_prefix: bool, depth: usize) -> Option<Named> {
    let module = &modules[at];
    let child = module.children.get(name).map(|child| Named::Module(*child));
    let item = module.items.contains(name).then_some(Named::ItemOf(at));
    let own = if is_prefix { child.or(item) } else { item.or(child) };
    let imported = || {
        let found = module.imports.iter().filter(|import| import.name.as_deref() == Some(name));
        found.filter_map(|import| resolve_within(modules, at, &import.path, depth + 1)).next()
    };
    let from_all = || {
        let globs = module.imports.iter().filter(|import| import.name.is_none());
        let sources = globs.filter_map(|glob| resolve_within(modules, at, &glob.path, depth + 1));
        let find = |source| match source {
            Named::Module(source) if depth < DEPTH_MAX && source != at => {
                look_up(modules, source, name, is_prefix, depth + 1)
            }
            _ => None,
        };
        sources.filter_map(find).next()
    };
    own.or_else(imported).or_else(from_all)
}
