//! Commands of `cosurf-aggregator`, each with its arguments: they parse, call the library and print.
//!
//! They refuse to know how anything is computed. What only a program may ask of the machine is in [`host`].
//!
//! Where to start reading: any command; each has a file of its name.

mod arguments;
mod cells;
pub(crate) mod convert;
pub(crate) mod eval;
pub(crate) mod eval_mesh;
pub(crate) mod forget;
pub(crate) mod host;
pub(crate) mod key;
pub(crate) mod merge;
pub(crate) mod mesh;
pub(crate) mod mission;
pub(crate) mod tap;
