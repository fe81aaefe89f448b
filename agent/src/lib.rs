//! The drone's side of cosurf: pictures with known poses in, a local model out.
//!
//! What it is: a training session within a memory limit ([`session`]), which can be killed at any time and resumes to
//! the same bits ([`checkpoint`]); scores of a model on held-out pictures ([`evaluate`]); renderings of a model as files
//! ([`pictures`]); publishing over a link ([`publish`]), with or without the ground that other devices observed better
//! ([`flights`]); and what changed between two models of the same ground ([`changes`]).
//!
//! What it refuses to know: the aggregator's code, and what becomes of the model there. It never sends a picture.
//!
//! Where to start reading: [`session`].
//!
//! ```no_run
//! use cosurf_agent::session::{Session, Split, TrainPlan};
//! use cosurf_engine::{DeviceChoice, SurfaceSettings};
//!
//! let plan = TrainPlan {
//!     data: "flight-7".into(),
//!     split: Split::Every(8),
//!     steps: 3000,
//!     seed: 0,
//!     memory_bytes: 1 << 30,
//!     max_size_px: u32::MAX,
//!     device: DeviceChoice::Cpu,
//!     threads: 4,
//!     surface: Some(SurfaceSettings::default()),
//!     prune: None,
//!     exposure: false,
//!     init: None,
//!     one_of_many: false,
//! };
//! let mut session = Session::start(&plan, None)?;
//! while !session.trainer().is_done() {
//!     session.step()?;
//! }
//! let splats = session.into_splats()?;
//! println!("{} splats", splats.len());
//! # Ok::<(), anyhow::Error>(())
//! ```

pub mod changes;
pub mod checkpoint;
pub mod evaluate;
pub mod flights;
pub mod outputs;
pub mod pictures;
pub mod publish;
pub mod session;
pub mod usage;
pub mod warm_start;
