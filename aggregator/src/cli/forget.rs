//! `forget`: a device does not count any more.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_aggregator::service::{AggregatorConfig, withdraw};
use cosurf_wire::DeviceId;

/// Withdraw a device: the global model is rebuilt as if it had never sent what it has sent.
///
/// A service that runs notices within a second, another one when it starts. What the device makes later is welcome.
#[derive(Args)]
pub(crate) struct ForgetArgs {
    /// The device's id
    device: String,
    /// The service's configuration
    #[arg(long, value_name = "FILE", default_value = "aggregator.toml")]
    config: PathBuf,
}

pub(crate) fn run(args: &ForgetArgs) -> Result<()> {
    let device = DeviceId::new(&args.device).with_context(|| format!("device {:?}", args.device))?;
    let config = AggregatorConfig::read(&args.config)?;
    withdraw(&config.out, &device)?;
    writeln!(io::stdout().lock(), "{device} is withdrawn from {}", config.out.display())?;
    Ok(())
}
