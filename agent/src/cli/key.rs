//! `key`: makes a key pair for signatures.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_link::SecretKey;
use cosurf_wire::DeviceId;

/// Make a key that signs this device's models, and print the public key for the aggregator.
///
/// The secret key is written to a new file that only you may read; set `key` in agent.toml to its path. Add the printed
/// line to the file that `trusted` names in aggregator.toml.
#[derive(Args, Debug)]
pub(super) struct KeyArgs {
    /// The file to write the secret key to; an existing file is not overwritten
    file: PathBuf,
    /// This device's id, as in agent.toml
    #[arg(long, value_name = "NAME")]
    device: DeviceId,
}

pub(super) fn run(args: &KeyArgs) -> Result<()> {
    let mut random = [0; 32];
    getrandom::fill(&mut random).context("the operating system gives no random numbers")?;
    let key = SecretKey::new(&random);
    key.write_new(&args.file)?;
    writeln!(io::stdout().lock(), "{}", key.public_line(&args.device))?;
    Ok(())
}
