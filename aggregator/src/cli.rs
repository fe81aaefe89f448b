//! The commands of `cosurf-aggregator` with their arguments, except `run`, which is in `main.rs`. Each command parses
//! its arguments, calls the library and prints the result.
//!
//! What it knows nothing about: how results are computed. What several commands ask the computer for, such as the
//! number of cores, is in [`host`]; at which addresses a browser opens what they serve, in [`address`].
//!
//! Where to start reading: any command. Each has a file of the same name; `record` and `replay` are in `tap`.

pub(crate) mod address;
pub(crate) mod arguments;
pub(crate) mod convert;
pub(crate) mod doctor;
pub(crate) mod eval;
pub(crate) mod eval_mesh;
pub(crate) mod forget;
pub(crate) mod host;
pub(crate) mod key;
pub(crate) mod merge;
pub(crate) mod mesh;
pub(crate) mod mission;
pub(crate) mod password;
pub(crate) mod pki;
pub(crate) mod restore;
pub(crate) mod revoke;
pub(crate) mod survey;
pub(crate) mod tap;
pub(crate) mod town;
pub(crate) mod view;
pub(crate) mod worker;
