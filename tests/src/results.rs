//! The results of benches. They are stored as JSON and shown as tables in the documents. A result that gets worse is
//! reported.
//!
//! A bench fills a [`Measurement`], which prints the rows and writes `NAME.json`. The program `results` runs benches
//! and compares each new `NAME.json` with the stored one in `shared/docs/results` ([`guard`]). If no figure got worse,
//! it replaces the stored file. Then it updates the tables of `shared/docs/RESULTS.md` and `README.md` ([`document`]).

pub mod document;
pub mod guard;
pub mod machine;
mod measurement;
mod provenance;
mod record;
pub mod store;
mod table;

pub use measurement::Measurement;
pub use record::{Better, Column, Results, Row, Tolerance};
