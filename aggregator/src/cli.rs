//! Commands of `cosurf-aggregator`, each with its arguments.

pub(crate) mod eval;
