//! `forget`: withdraws the models of a device from the global model.

use std::io::{self, Write};
use std::path::Path;

use anyhow::{Context, Result, ensure};
use clap::Args;
use cosurf_aggregator::service::{senders, withdraw};
use cosurf_wire::DeviceId;

use super::arguments::ConfigArgs;

/// Withdraw a device: rebuild the global model without the models that the device has sent so far.
///
/// A running service notices the withdrawal within about a second, a stopped service when it starts. Models that the
/// device sends later are accepted.
#[derive(Args)]
pub(crate) struct ForgetArgs {
    /// Id of the device
    device: String,
    #[command(flatten)]
    config: ConfigArgs,
    /// Accept a device that has sent no model, to delete the flight that it has announced
    #[arg(long)]
    announced: bool,
}

pub(crate) fn run(args: &ForgetArgs) -> Result<()> {
    let device = DeviceId::new(&args.device).with_context(|| format!("device {:?}", args.device))?;
    let config = args.config.read()?;
    if !args.announced {
        check_sender(&config.out, &device)?;
    }
    withdraw(&config.out, &device)?;
    writeln!(io::stdout().lock(), "{device} is withdrawn from {}", config.out.display())?;
    Ok(())
}

/// Fails if the service with this folder has no model of the device.
fn check_sender(folder: &Path, device: &DeviceId) -> Result<()> {
    let senders = senders(folder)?;
    let names: Vec<&str> = senders.iter().map(DeviceId::as_str).collect();
    let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    ensure!(
        senders.contains(device),
        "{} has no model of {device}; devices with a model: {names}. If {device} has only announced a flight, add \
         --announced",
        folder.display()
    );
    Ok(())
}
