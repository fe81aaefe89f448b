//! `key`: makes a signing key.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_link::SecretKey;
use cosurf_wire::DeviceId;

/// Make a key that signs the global model, and print the public key for the agents.
///
/// The secret key is written to a new file that only you may read; set `key` in aggregator.toml to its path. Add the
/// printed line to the file that `trusted` names in each agent.toml.
#[derive(Args)]
pub(crate) struct KeyArgs {
    /// File for the secret key; an existing file is not overwritten
    file: PathBuf,
    /// Name of the aggregator on its site, as in aggregator.toml
    #[arg(long, value_name = "NAME", default_value = "aggregator")]
    device: DeviceId,
}

pub(crate) fn run(args: &KeyArgs) -> Result<()> {
    let mut random = [0; 32];
    getrandom::fill(&mut random).context("the system provides no random numbers")?;
    let key = SecretKey::new(&random);
    key.write_new(&args.file)?;
    writeln!(io::stdout().lock(), "{}", key.public_line(&args.device))?;
    Ok(())
}
