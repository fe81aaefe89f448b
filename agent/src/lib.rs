//! The agent of cosurf: trains a local model on a drone's pictures with known poses, and sends the model to the
//! aggregator.
//!
//! What it is:
//! - [`session`]: training within a memory limit. A training that is killed and resumed gives the same bits as one that
//!   runs without a stop ([`checkpoint`]).
//! - [`ingest`]: photographs to pictures with poses, by COLMAP, in their place on the earth.
//! - [`arrival`]: whether the pictures of a flight have arrived in a folder, and are complete.
//! - [`cell`]: the pictures of the agent's cell of the site's plan.
//! - [`evaluate`]: scores of a model on held-out pictures.
//! - [`pictures`]: renderings of a model as files.
//! - [`publish`]: the upload of the model over a link, and the download of the global model. The upload can leave out
//!   ground that other devices observed better ([`flights`]).
//! - [`status`]: how far the agent is, told over the link.
//! - [`changes`]: the differences between two models of the same ground.
//!
//! What it knows nothing about: the aggregator's code, and what the aggregator does with the model. The agent never
//! sends a picture.
//!
//! Where to start reading: [`session`].
//!
//! ```no_run
//! use cosurf_agent::session::{Session, Split, TrainPlan};
//! use cosurf_engine::{DeviceChoice, PoseChoice, SurfaceSettings};
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
//!     poses: PoseChoice::Auto,
//!     init: None,
//!     one_of_many: false,
//! };
//! let mut session = Session::start(&plan, None)?;
//! while !session.trainer().is_done() {
//!     session.step()?;
//! }
//! let splats = session.into_model()?.into_splats();
//! println!("{} splats", splats.len());
//! # Ok::<(), anyhow::Error>(())
//! ```

pub mod arrival;
pub mod cell;
pub mod changes;
pub mod checkpoint;
pub mod evaluate;
pub mod flights;
pub mod ingest;
pub mod outputs;
pub mod pictures;
pub mod publish;
mod random_start;
pub mod session;
pub mod status;
mod training_frame;
pub mod viewing;
pub mod warm_start;
