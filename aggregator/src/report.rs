//! The results of a mission for a reader: figures (`report.json`), a table, and a page (`report.html`).
//!
//! It refuses to know how a mission runs: it gets figures, cells and views, and returns text.
//!
//! Where to start reading: [`MissionReport`], the figures; [`texts`], the figures as text; [`page()`].

mod chart;
mod embed;
mod figures;
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
