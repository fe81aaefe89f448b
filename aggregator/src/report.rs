//! What a mission leaves to be read: its figures (`report.json`), the same as a table, and a page (`report.html`).
//!
//! It refuses to know how a mission runs: it gets figures, cells and views, and returns text.
//!
//! Where to start reading: [`MissionReport`], the figures; [`texts`], what is said of them; [`page()`].

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
