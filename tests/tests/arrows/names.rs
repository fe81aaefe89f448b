//! Finds the module that defines the item that a path names.

use crate::modules::Module;

/// Maximum number of re-exports that are followed in a row. A longer chain is assumed to lead back to itself.
const DEPTH_MAX: usize = 16;

/// What a path names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Named {
    /// An item that the module with this index defines.
    ItemOf(usize),
    /// The module with this index.
    Module(usize),
}

/// Finds what `path` names where it is written in module `from`. `None` for names of other crates and of local
/// variables.
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
            // A macro defines the name, or the module re-exports it from another crate: it counts as an item of this
            // module.
            None if is_rooted => return Some(Named::ItemOf(at)),
            None => return None,
        }
        (rest, is_rooted) = (others, true);
    }
    is_rooted.then_some(Named::Module(at))
}

/// Finds what `name` means in module `at`. A name may mean both a child module and an item. The module is meant if
/// more of a path follows (`is_prefix`), otherwise the item.
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
