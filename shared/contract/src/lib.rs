//! The data formats that an agent shares with the program that starts it. The messages between agents and aggregator
//! are in `cosurf_wire`.
//!
//! What it is:
//! - [`AgentConfig`]: the content of `agent.toml`, which people and the command `mission` write. [`parse_toml`] reads
//!   `aggregator.toml` too, with the same errors.
//! - [`AgentEvent`]: the JSON lines that an agent prints under `--json`.
//! - [`TrainReport`] and [`Changes`]: JSON files that an agent writes.
//! - [`log`]: the log of `cosurf-agent` and `cosurf-aggregator`.
//! - [`usage`]: how much memory and time a process takes.
//! - [`counted`]: how both write a count with its noun.
//!
//! Values are parsed into the types that the programs compute with, so a wrong value is refused where it is read.
//!
//! What it knows nothing about: how an agent trains or sends its model, what the aggregator does with the model, files,
//! and command lines. Only [`log`] reads a clock, and only [`usage`] asks the system.
//!
//! Where to start reading: [`config`], then [`report`].
//!
//! ```
//! use cosurf_contract::{AgentConfig, AgentEvent};
//!
//! let text = r#"
//! device = "drone-1"
//! site = "quarry"
//! broker = "mqtt://192.168.1.10:1883"
//! data = "/data/flight-7"
//! out = "/data/flight-7/model"
//! steps = 3000
//! "#;
//! let config = AgentConfig::from_toml(text)?;
//! assert_eq!((config.device.map(|device| device.to_string()).as_deref(), config.seed), (Some("drone-1"), 0));
//!
//! let wrong = text.replace("drone-1", "drone 1");
//! let error = AgentConfig::from_toml(&wrong).unwrap_err().to_string();
//! let shown = "line 2, device: ' ' in a name: use only A-Z a-z 0-9 _ -
//!   2 | device = \"drone 1\"
//!     |          ^^^^^^^^^";
//! assert_eq!(error, shown);
//!
//! let line = r#"{"event":"acknowledged","bytes_sent":4096}"#;
//! let event: AgentEvent = serde_json::from_str(line).expect("an event");
//! assert_eq!(event, AgentEvent::Acknowledged { bytes_sent: 4096 });
//! # Ok::<(), cosurf_contract::ConfigError>(())
//! ```

pub mod config;
mod curve;
pub mod log;
mod password;
pub mod report;
mod share;
pub mod status;
pub mod usage;
mod words;

/// Environment variable that a mission sets for the agents that it starts, to any value: the agent ends, as at Ctrl-C, once
/// its standard input is closed. So no agent outlives a mission that is killed.
pub const ENDS_WITH_STDIN: &str = "COSURF_ENDS_WITH_STDIN";

pub use config::{
    AgentConfig, AgentLink, CHECKPOINT, ConfigError, DEFAULT_FLIGHTS_MAX, DEFAULT_STEPS, amount, parse_toml,
};
pub use cosurf_link::TlsFiles;
pub use curve::Curve;
pub use log::{LogError, LogFormat};
pub use password::{PasswordError, read_password};
pub use report::{
    AgentEvent, Changes, ChosenBy, ComparedWith, IngestReport, IngestStage, ReadyReport, TrainReport,
};
pub use share::{NotAShare, Share};
pub use status::{AgentPhase, AgentStatus, BadStatus};
pub use words::{Escaped, counted};
