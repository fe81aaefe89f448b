//! Presents the results of a mission: figures (`report.json`), a table for the terminal, and a page
//! (`report.html`). For a service, which has no photographs, it presents the global model alone ([`SiteReport`]).
//!
//! What it knows nothing about: how a mission runs. It gets figures, cells and views, and returns text.
//!
//! A page begins with the client's part ([`Client`]): the model to walk through, and how exact it is. The engineer's
//! part follows.
//!
//! Where to start reading: [`MissionReport`], the figures; then [`texts`], which writes them as text,
//! and [`page()`].

mod chart;
mod client;
mod embed;
mod figures;
mod fits;
mod frame;
mod map;
mod page;
mod rows;
mod showcase;
mod site;
mod svg;
mod texts;

pub(crate) use client::Client;
pub(crate) use embed::Captioned;
pub use figures::{AgentSummary, EdgeSummary, MeshSummary, MissionReport, PhaseTime, WholeSummary};
pub(crate) use page::{Drawings, page};
pub(crate) use showcase::{Showcase, ShowcaseError, showcases};
pub use site::SiteReport;
pub(crate) use site::{SitePicture, site_page};
pub(crate) use svg::escape;
pub use texts::table;
