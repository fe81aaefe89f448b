//! How good a model or a mesh is: colours against photographs, surfaces against a true surface.
//!
//! It refuses to know where a model comes from and who reads the figures: it compares files, renderings and meshes.
//! The receiving service never uses it, as it has no photographs; missions, `eval` and `eval-mesh` do.
//!
//! Where to start reading: [`Judge`], a model on one photograph after the other; [`evaluate_model`], what `eval` does;
//! then the measures: [`surface`], [`lpips`] and, for meshes, [`accuracy`].

pub mod accuracy;
mod judge;
mod lpips;
mod model;
mod quality;
mod surface;

pub(crate) use judge::{Comparison, Judge};
pub use lpips::{LpipsError, LpipsScore};
pub use model::{EvalError, EvalOrder, EvalReport, ViewQuality, evaluate_model, model_path, table};
pub(crate) use quality::Yardsticks;
pub use quality::{Quality, YardstickError};
pub use surface::{Spread, SurfaceQuality};
pub(crate) use surface::{depth_errors_percent, normal_errors_deg};
