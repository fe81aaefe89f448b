//! `key`: a key to sign with.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_link::SecretKey;
use cosurf_wire::DeviceId;

/// Make a key for signing the global model, and print the line for the agents' lists.
///
/// The secret goes into a new file that only you may read; name it as `key` in aggregator.toml. The line that
/// is printed goes into the file that each agent.toml names as `trusted`.
#[derive(Args)]
pub(crate) struct KeyArgs {
    /// Where the secret goes; a file that is there is not overwritten
    file: PathBuf,
    /// The aggregator's name on its site, as in aggregator.toml
    #[arg(long, value_name = "NAME", default_value = "aggregator")]
    device: DeviceId,
}

pub(crate) fn run(args: &KeyArgs) -> Result<()> {
    let mut random = [0; 32];
    getrandom::fill(&mut random).context("the system has no random numbers")?;
    let key = SecretKey::new(&random);
    key.write_new(&args.file)?;
    writeln!(io::stdout().lock(), "{}", key.public_line(&args.device))?;
    Ok(())
}
