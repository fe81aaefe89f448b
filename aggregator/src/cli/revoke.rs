//! `revoke`: refuses a device from now on, whatever key, certificate or password it shows.

use std::io::{self, Write};

use anyhow::{Context, Result, ensure};
use clap::Args;
use cosurf_aggregator::service::{readmit, revoke, senders, withdraw};
use cosurf_wire::DeviceId;

use super::arguments::ConfigArgs;

/// Revoke a device: nothing that it sends counts any more, whatever key, certificate or password it shows.
///
/// A running service notices within about a second, a stopped one when it starts. The built-in broker ends the device's
/// connections, and refuses new ones if it asks for certificates or passwords. Models that the device has sent count until
/// they are forgotten. To give the device new keys: `pki DIR --revoke NAME --device NAME`, then `revoke NAME --undo`.
#[derive(Args)]
pub(crate) struct RevokeArgs {
    /// Id of the device
    device: String,
    #[command(flatten)]
    config: ConfigArgs,
    /// Also withdraw the models that the device has sent so far, as `forget` does
    #[arg(long)]
    forget: bool,
    /// Let the device take part again, with the keys that the site accepts
    #[arg(long, conflicts_with = "forget")]
    undo: bool,
}

pub(crate) fn run(args: &RevokeArgs) -> Result<()> {
    let device = DeviceId::new(&args.device).with_context(|| format!("device {:?}", args.device))?;
    let folder = args.config.read()?.out;
    let mut out = io::stdout().lock();
    if args.undo {
        ensure!(readmit(&folder, &device)?, "{device} is not revoked in {}", folder.display());
        writeln!(out, "{device} may take part again in {}", folder.display())?;
        return Ok(());
    }
    let is_known = senders(&folder)?.contains(&device);
    revoke(&folder, &device)?;
    writeln!(out, "{device} is revoked in {}", folder.display())?;
    if args.forget {
        withdraw(&folder, &device)?;
        writeln!(out, "its models are withdrawn")?;
    }
    if !is_known {
        writeln!(out, "note: it has sent no model; check the name if you expected one")?;
    }
    Ok(())
}
