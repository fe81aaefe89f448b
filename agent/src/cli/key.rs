//! `key`: makes a signing key.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_link::SecretKey;
use cosurf_wire::DeviceId;

/// Make a key for signing this device's models, and print the line for the aggregator's list.
///
/// The secret goes into a new file that only you may read; name it as `key` in agent.toml. The line that is
/// printed goes into the file that aggregator.toml names as `trusted`.
#[derive(Args, Debug)]
pub(super) struct KeyArgs {
    /// File for the secret key; an existing file is not overwritten
    file: PathBuf,
    /// This device's name on its site, as in agent.toml
    #[arg(long, value_name = "NAME")]
    device: DeviceId,
}

pub(super) fn run(args: &KeyArgs) -> Result<()> {
    let mut random = [0; 32];
    getrandom::fill(&mut random).context("the system provides no random numbers")?;
    let key = SecretKey::new(&random);
    key.write_new(&args.file)?;
    writeln!(io::stdout().lock(), "{}", key.public_line(&args.device))?;
    Ok(())
}
