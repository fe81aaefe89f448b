//! What benches measure: stored as JSON, shown as the tables of the documents, and guarded against getting worse.
//!
//! A bench fills a [`Measurement`], which prints its rows and writes `NAME.json`. The program `results` runs benches,
//! compares what they wrote with `shared/docs/results/NAME.json` ([`guard`]), stores it there, and writes the tables of
//! `shared/docs/RESULTS.md` and `README.md` anew ([`document`]).

pub mod document;
pub mod guard;
pub mod machine;
mod measurement;
mod record;
pub mod store;
mod table;

pub use measurement::Measurement;
pub use record::{Better, Column, Results, Row, Tolerance};
