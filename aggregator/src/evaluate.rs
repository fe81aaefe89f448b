//! Measures how good a model or a mesh is: its colours against photographs, its surface against a true surface.
//!
//! What it knows nothing about: where a model comes from, and who reads the figures. It compares files, renderings and
//! meshes. The receiving service never uses it, because the service has no photographs. Missions, `eval` and
//! `eval-mesh` use it.
//!
//! Where to start reading: [`Judge`], which compares a model with one photograph after the other; [`evaluate_model`],
//! which the command `eval` runs; then the measures: [`surface`], [`lpips`] and, for meshes, [`accuracy`].

pub mod accuracy;
mod judge;
mod lpips;
mod model;
mod quality;
mod splats;
mod surface;

pub(crate) use judge::{Comparison, Judge};
pub use lpips::{LpipsError, LpipsScore};
pub use model::{EvalError, EvalOrder, EvalReport, ViewQuality, evaluate_model, table};
pub(crate) use quality::Yardsticks;
pub use quality::{Quality, YardstickError};
pub(crate) use splats::splat_errors;
pub use surface::{Spread, SurfaceQuality};
pub(crate) use surface::{depth_errors_percent, normal_errors_deg};
