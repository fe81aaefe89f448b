//! `pki`: makes and revokes the keys of a site.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use cosurf_aggregator::pki::{Done, Pki, Wish};
use cosurf_wire::DeviceId;

/// Make the certificates and signing keys of a site, or revoke some.
///
/// The first call makes an authority for the site, and files for the broker and for the aggregator. Each --device gets a
/// folder with its files; copy it to that device. The folder `broker` is for the broker. Keep DIR itself where no one else
/// can read it: with its authority.key, anyone can be let in.
///
/// After --revoke, copy `broker` to the broker and `aggregator` to the aggregator again, and restart both.
#[derive(Args)]
pub(crate) struct PkiArgs {
    /// Folder for all keys of the site
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Name or address of the broker's computer, as its clients write it; may be given several times. Needed in the first
    /// call; later, it makes a new certificate for the broker
    #[arg(long = "host", value_name = "NAME")]
    hosts: Vec<String>,
    /// Name of a device that gets keys; may be given several times
    #[arg(long = "device", value_name = "NAME")]
    devices: Vec<DeviceId>,
    /// Name of a participant whose keys are revoked; may be given several times. It may get new ones in the same call
    #[arg(long = "revoke", value_name = "NAME")]
    revoked: Vec<DeviceId>,
    /// Name of the aggregator, as in aggregator.toml
    #[arg(long, value_name = "NAME", default_value = "aggregator")]
    aggregator: DeviceId,
    /// Days until new certificates expire
    #[arg(long, value_name = "N", default_value_t = 730, value_parser = clap::value_parser!(u32).range(1..=3650))]
    days: u32,
}

pub(crate) fn run(args: PkiArgs) -> Result<()> {
    let PkiArgs { folder, hosts, devices, revoked, aggregator, days } = args;
    let Done { made, revoked } =
        Pki::open(&folder)?.fulfil(&Wish { hosts, aggregator, devices, revoked, days })?;
    let mut out = io::stdout().lock();
    for name in revoked {
        writeln!(out, "revoked {name}")?;
    }
    for folder in made {
        writeln!(out, "made {}", folder.display())?;
    }
    Ok(())
}
