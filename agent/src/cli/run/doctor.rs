//! `doctor`: checks the computer, and the way to the aggregator, without pictures. `preflight` also checks those.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use clap::Args;
use cosurf_cli::doctor::{Doctor, Finding, clock, colmap, compute, disk, line, memory};
use cosurf_contract::AgentConfig;
use cosurf_link::serial::DEVICE_MESSAGE_BYTES;
use cosurf_link::{Identity, MqttConfig, Role, SerialConfig, SerialTransport};
use cosurf_scene::{FolderLock, SceneError};

use super::route::Route;
use crate::cli::host::{self, default_memory};

/// Room on the disk for checkpoints of half a million splats, and their model, bytes.
const ROOM_BYTES: u64 = 1 << 30;

/// Check this computer and the way to the aggregator, and tell what to mend: clock, memory, graphics card, disk, broker or
/// radio, COLMAP. Fails if anything must be mended. Needs no pictures; `preflight` checks those too.
#[derive(Args, Debug)]
pub(in crate::cli) struct DoctorArgs {
    /// The configuration file; without one, only the computer is checked
    #[arg(long, value_name = "FILE", default_value = "agent.toml")]
    config: PathBuf,
    /// Print JSON instead of text, one line for each check
    #[arg(long)]
    json: bool,
}

pub(in crate::cli) fn doctor(args: &DoctorArgs) -> Result<()> {
    let mut doctor = Doctor::new(args.json);
    let config = read(&args.config);
    let config = match &config {
        Ok(Some(config)) => {
            doctor.tell(&Finding::ok("config", format!("{} can be read", args.config.display())))?;
            Some(config)
        }
        Ok(None) => {
            let found = format!("{}: there is no such file", args.config.display());
            doctor.tell(&Finding::note("config", found, "write it, or name another with --config"))?;
            None
        }
        Err(error) => {
            doctor.tell(&Finding::failed("config", format_args!("{error:#}")))?;
            None
        }
    };
    doctor.tell(&clock::check())?;
    let memory_bytes = config.and_then(|config| config.memory_bytes).unwrap_or_else(default_memory);
    doctor.tell(&memory::check(memory_bytes, "`memory`"))?;
    doctor.tell(&compute::check(config.and_then(|config| config.compute).unwrap_or_default()))?;
    doctor.tell(&disk::check(config.map_or(Path::new("out"), |config| &config.out), ROOM_BYTES))?;
    if let Some(config) = config {
        let finding = line(config).unwrap_or_else(|error| Finding::failed("line", format_args!("{error:#}")));
        doctor.tell(&finding)?;
    }
    doctor.tell(&colmap::check())?;
    doctor.finish()
}

/// Reads the configuration; `None` if there is no such file.
fn read(path: &Path) -> Result<Option<AgentConfig>> {
    let name = || path.display().to_string();
    if !path.exists() {
        return Ok(None);
    }
    let text = fs::read_to_string(path).with_context(name)?;
    Ok(Some(AgentConfig::from_toml(&text).with_context(name)?))
}

/// Connects to the broker, or opens the radio's port. Not while another program does: the broker would end its connection.
fn line(config: &AgentConfig) -> Result<Finding> {
    let lock = config.out.is_dir().then(|| FolderLock::take(&config.out, "cosurf-agent doctor")).transpose();
    let _lock = match lock {
        Err(SceneError::InUse { holder, .. }) => {
            return Ok(Finding::ok("line", format!("not checked: {holder} uses it")));
        }
        lock => lock?,
    };
    let device = config.device.map_or_else(host::device, Ok)?;
    let session = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    let identity = Identity { site: config.site, device, session, role: Role::Device };
    Ok(match Route::of(config, device)? {
        Route::Broker { broker, tls, login } => {
            line::broker("line", MqttConfig { broker, identity, will: None, tls, login })
        }
        Route::Serial { port, baud } => {
            let radio = SerialConfig::device(&port, baud, session, DEVICE_MESSAGE_BYTES);
            line::radio("line", &port, &mut SerialTransport::start(radio))
        }
    })
}
