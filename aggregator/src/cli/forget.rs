//! `forget`: withdraws a device's models from the global model.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_aggregator::service::{AggregatorConfig, withdraw};
use cosurf_wire::DeviceId;

/// Withdraw a device: the global model is rebuilt without the models that it has sent so far.
///
/// A running service notices within a second, a stopped one when it starts. Later models of the device are accepted.
#[derive(Args)]
pub(crate) struct ForgetArgs {
    /// Id of the device
    device: String,
    /// Configuration file of the service
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
