//! `password`: makes the line of a user in the file of users.

use std::io::{self, BufRead, Write};

use anyhow::{Context, Result};
use clap::Args;
use cosurf_aggregator::broker::user_line;
use cosurf_wire::DeviceId;

/// Read a password from standard input, and print the line for the built-in broker's file of users.
///
/// Add the printed line to the file that `users` names in aggregator.toml. The device gets the password in the file
/// that `password_file` names in its agent.toml.
#[derive(Args)]
pub(crate) struct PasswordArgs {
    /// Name of the device, as in its agent.toml
    device: DeviceId,
}

pub(crate) fn run(args: &PasswordArgs) -> Result<()> {
    let mut password = String::new();
    io::stdin().lock().read_line(&mut password).context("standard input cannot be read")?;
    let mut salt = [0; 16];
    getrandom::fill(&mut salt).context("the system provides no random numbers")?;
    let line = user_line(&args.device, password.trim_end_matches(['\r', '\n']), salt)?;
    writeln!(io::stdout().lock(), "{line}")?;
    Ok(())
}
