//! Commands of `cosurf-aggregator`, each with its arguments.

pub(crate) mod convert;
pub(crate) mod eval;
pub(crate) mod eval_mesh;
pub(crate) mod forget;
pub(crate) mod key;
pub(crate) mod merge;
pub(crate) mod mesh;
pub(crate) mod tap;

use std::io::{self, IsTerminal};

use cosurf_aggregator::Display;

/// How progress is shown.
pub(crate) fn display(json: bool) -> Display {
    match (json, io::stderr().is_terminal()) {
        (true, _) => Display::Json,
        (false, true) => Display::Bars,
        (false, false) => Display::Lines,
    }
}
