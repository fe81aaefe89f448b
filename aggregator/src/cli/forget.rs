//! `forget`: withdraws the models of a device from the global model.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_aggregator::service::{AggregatorConfig, withdraw};
use cosurf_wire::DeviceId;

/// Withdraw a device: rebuild the global model without the models that the device has sent so far.
///
/// A running service notices the withdrawal within about a second, a stopped service when it starts. Models that the
/// device sends later are accepted.
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
