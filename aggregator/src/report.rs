//! Presents the results of a mission: figures (`report.json`), a table for the terminal, and a page
//! (`report.html`).
//!
//! What it knows nothing about: how a mission runs. It gets figures, cells and views, and returns text.
//!
//! Where to start reading: [`MissionReport`], the figures; then [`texts`], which writes them as text,
//! and [`page()`].

mod chart;
mod embed;
mod figures;
mod fits;
mod map;
mod page;
mod rows;
mod showcase;
mod svg;
mod texts;

pub use figures::{AgentSummary, EdgeSummary, MeshSummary, MissionReport, WholeSummary};
pub(crate) use page::{Drawings, page};
pub(crate) use showcase::{Showcase, showcases};
pub use texts::table;
