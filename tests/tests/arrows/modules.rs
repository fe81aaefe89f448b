//! Reads the modules of a crate, and the names that each module uses, from the crate's sources.
//!
//! Code that is compiled only for tests (`cfg(test)`) is left out. The arguments of macros are not parsed as code:
//! whatever looks like a path in them counts as a path. Names in attributes are ignored.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

use proc_macro2::{TokenStream, TokenTree};
use syn::visit::{self, Visit};
use syn::{Attribute, Item, Meta, Token, UseTree, Visibility};

/// The parts of a path as it is written. The first part is `crate`, `self`, `super` or a name.
pub(crate) type Names = Vec<String>;

/// One module of a crate.
#[derive(Default)]
pub(crate) struct Module {
    /// Path from the crate's root, for example `cpu::surface`; empty for the root.
    pub(crate) path: String,
    pub(crate) parent: Option<usize>,
    pub(crate) children: HashMap<String, usize>,
    /// Names of the items that the module defines, without its child modules.
    pub(crate) items: HashSet<String>,
    /// The names that the module's `use` declarations import.
    pub(crate) imports: Vec<Import>,
    /// Paths in the module's own code.
    pub(crate) paths: Vec<Names>,
}

/// One name that a `use` declaration imports.
pub(crate) struct Import {
    /// The name by which this module knows the item; `None` for a glob import (`*`) of all names of `path`.
    pub(crate) name: Option<String>,
    pub(crate) path: Names,
    /// Whether the import is a re-export: a `pub use`, or one of limited visibility such as `pub(crate) use`.
    pub(crate) is_reexport: bool,
}

/// Reads the modules of the crate whose root file is `file`. The root comes first, and parents come before their
/// children.
pub(crate) fn read(file: &Path) -> Vec<Module> {
    let text = fs::read_to_string(file).unwrap();
    modules_of(&text, file.parent().unwrap())
}

/// Reads the modules of a crate. `text` is the content of its root file, and its other files lie in `folder`.
pub(crate) fn modules_of(text: &str, folder: &Path) -> Vec<Module> {
    let mut reader = Reader { modules: vec![Module::default()], module: 0, folder: folder.into() };
    reader.visit_file(&syn::parse_file(text).unwrap());
    reader.modules
}

struct Reader {
    modules: Vec<Module>,
    /// Index of the module that is being read.
    module: usize,
    /// Folder with the files of the children of `module`.
    folder: PathBuf,
}

impl Reader {
    fn here(&mut self) -> &mut Module {
        &mut self.modules[self.module]
    }

    fn read_child(&mut self, child: &syn::ItemMod) {
        let name = child.ident.to_string();
        let index = self.modules.len();
        let path = [&self.here().path, &name].map(String::as_str).join("::");
        let path = path.trim_start_matches("::").to_owned();
        self.here().children.insert(name.clone(), index);
        self.modules.push(Module { path, parent: Some(self.module), ..Module::default() });
        let parent = (self.module, self.folder.clone());
        (self.module, self.folder) = (index, self.folder.join(&name));
        match &child.content {
            Some((_, items)) => items.iter().for_each(|item| self.visit_item(item)),
            None => {
                let files = [self.folder.with_extension("rs"), self.folder.join("mod.rs")];
                let file = files.iter().find(|file| file.is_file()).expect("a file of the module");
                self.visit_file(&syn::parse_file(&fs::read_to_string(file).unwrap()).unwrap());
            }
        }
        (self.module, self.folder) = parent;
    }

    /// Records every name that a `use` declaration imports. `before` is the path in front of `tree`.
    fn import(&mut self, tree: &UseTree, before: &Names, is_reexport: bool) {
        let with = |ident: &syn::Ident| [before.clone(), vec![ident.to_string()]].concat();
        let (name, path) = match tree {
            UseTree::Path(inner) => return self.import(&inner.tree, &with(&inner.ident), is_reexport),
            UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.import(tree, before, is_reexport));
            }
            UseTree::Glob(_) => (None, before.clone()),
            UseTree::Name(name) if name.ident == "self" => (before.last().cloned(), before.clone()),
            UseTree::Name(name) => (Some(name.ident.to_string()), with(&name.ident)),
            UseTree::Rename(rename) if rename.ident == "self" => {
                (Some(rename.rename.to_string()), before.clone())
            }
            UseTree::Rename(rename) => (Some(rename.rename.to_string()), with(&rename.ident)),
        };
        self.here().imports.push(Import { name, path, is_reexport });
    }

    /// Records whatever looks like a path in the arguments of a macro: names joined by `::`.
    fn scan(&mut self, tokens: TokenStream) {
        let mut path: Names = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Punct(punct) if punct.as_char() == ':' && !path.is_empty() => colons += 1,
                TokenTree::Ident(ident) => {
                    if colons != 2 {
                        self.here().paths.push(std::mem::take(&mut path));
                    }
                    path.push(ident.to_string());
                    colons = 0;
                }
                other => {
                    self.here().paths.push(std::mem::take(&mut path));
                    colons = 0;
                    if let TokenTree::Group(group) = other {
                        self.scan(group.stream());
                    }
                }
            }
        }
        self.here().paths.push(path);
    }
}

impl<'a> Visit<'a> for Reader {
    fn visit_item(&mut self, item: &'a Item) {
        let (attributes, name) = described(item);
        if attributes.iter().any(is_for_tests) {
            return;
        }
        self.here().items.extend(name.map(ToString::to_string));
        match item {
            Item::Mod(child) => self.read_child(child),
            Item::Use(item) if item.leading_colon.is_none() => {
                self.import(&item.tree, &Names::new(), !matches!(item.vis, Visibility::Inherited));
            }
            _ => visit::visit_item(self, item),
        }
    }

    fn visit_impl_item_fn(&mut self, function: &'a syn::ImplItemFn) {
        if !function.attrs.iter().any(is_for_tests) {
            visit::visit_impl_item_fn(self, function);
        }
    }

    fn visit_path(&mut self, path: &'a syn::Path) {
        if path.leading_colon.is_none() {
            let names = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
            self.here().paths.push(names);
        }
        visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, call: &'a syn::Macro) {
        self.visit_path(&call.path);
        self.scan(call.tokens.clone());
    }

    fn visit_attribute(&mut self, _: &'a Attribute) {}
}

/// The attributes of an item, and the name that the item defines, if any.
fn described(item: &Item) -> (&[Attribute], Option<&syn::Ident>) {
    match item {
        Item::Const(item) => (&item.attrs, Some(&item.ident)),
        Item::Enum(item) => (&item.attrs, Some(&item.ident)),
        Item::Fn(item) => (&item.attrs, Some(&item.sig.ident)),
        Item::Impl(item) => (&item.attrs, None),
        Item::Macro(item) => (&item.attrs, item.ident.as_ref()),
        Item::Mod(item) => (&item.attrs, None),
        Item::Static(item) => (&item.attrs, Some(&item.ident)),
        Item::Struct(item) => (&item.attrs, Some(&item.ident)),
        Item::Trait(item) => (&item.attrs, Some(&item.ident)),
        Item::Type(item) => (&item.attrs, Some(&item.ident)),
        Item::Union(item) => (&item.attrs, Some(&item.ident)),
        Item::Use(item) => (&item.attrs, None),
        _ => (&[], None),
    }
}

/// Whether an attribute is a `cfg` that keeps its item only in builds for tests.
fn is_for_tests(attribute: &Attribute) -> bool {
    attribute.path().is_ident("cfg")
        && attribute.parse_args().is_ok_and(|condition| !holds_without_tests(&condition))
}

/// Whether a `cfg` condition can hold in a build that is not for tests. Every option except `test` counts as
/// possible.
fn holds_without_tests(condition: &Meta) -> bool {
    let parts = |list: &syn::MetaList| {
        let parse = syn::punctuated::Punctuated::<Meta, Token![,]>::parse_terminated;
        list.parse_args_with(parse).map_or_else(|_| Vec::new(), |parts| parts.into_iter().collect())
    };
    match condition {
        Meta::Path(path) => !path.is_ident("test"),
        Meta::List(list) if list.path.is_ident("all") => parts(list).iter().all(holds_without_tests),
        Meta::List(list) if list.path.is_ident("any") => parts(list).iter().any(holds_without_tests),
        _ => true,
    }
}
