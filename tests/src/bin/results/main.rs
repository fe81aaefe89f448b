//! Runs benches, stores their figures, and writes the tables of RESULTS.md, README.md and TESTING.md.
//!
//! `cargo run --release -p cosurf-tests --bin results -- --help`

mod benches;
mod commands;
mod devices;
mod divan;
mod missions;
mod runs;
mod truth;

use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_tests::results::{document, guard, store};
use runs::{RUNS, Run, command_fault};

/// Runs benches, stores their figures in shared/docs/results and writes the tables of RESULTS.md, README.md and
/// TESTING.md
///
/// A figure that is worse than the stored one by more than its tolerance is reported. Then no figure of its bench is
/// stored, and the exit code is 1. Without names no bench runs, and the tables are written from the stored figures.
#[derive(Parser)]
struct Arguments {
    /// Benches to run; some take hours [see --list]
    names: Vec<String>,
    /// Only check the stored results, and that the documents show exactly their figures
    #[arg(long, conflicts_with_all = ["names", "accept"])]
    check: bool,
    /// List the benches
    #[arg(long, exclusive = true)]
    list: bool,
    /// Store figures even if they are worse than the stored ones, and do not report them
    #[arg(long)]
    accept: bool,
}

fn main() -> Result<ExitCode> {
    let arguments = Arguments::parse();
    if arguments.list {
        list()?;
        return Ok(ExitCode::SUCCESS);
    }
    let faults = if arguments.check {
        faults()?
    } else {
        let worse = measure(&arguments.names, arguments.accept)?;
        document::write_all()?;
        worse
    };
    faults.iter().for_each(|fault| eprintln!("{fault}"));
    Ok(if faults.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The faults of the stored results and of the documents, a sentence for each.
fn faults() -> Result<Vec<String>> {
    let stored = store::read_all(&store::folder())?;
    let mut faults = document::faults()?;
    faults.extend(stored.iter().filter_map(command_fault));
    Ok(faults)
}

/// Runs the benches with these names and stores their results. Returns a sentence for each figure that got worse.
/// With `accept`, worse figures are stored and not returned; otherwise their benches are not stored.
fn measure(names: &[String], accept: bool) -> Result<Vec<String>> {
    let find = |name: &String| RUNS.iter().find(|run| run.name == name);
    let runs: Vec<&Run> = names
        .iter()
        .map(|name| find(name).with_context(|| format!("there is no bench `{name}`; --list names all")))
        .collect::<Result<_>>()?;
    let mut worse = Vec::new();
    for run in runs {
        let new = run.measure().with_context(|| format!("{} was not measured", run.name))?;
        let stored = store::read(&store::folder(), run.name)?;
        let found = stored.map_or_else(Vec::new, |stored| guard::worse(&stored, &new));
        if found.is_empty() || accept {
            store::write(&store::folder(), &new)?;
        }
        if !accept {
            worse.extend(found);
        }
    }
    Ok(worse)
}

fn list() -> Result<()> {
    for Run { name, about, command, .. } in &RUNS {
        println!("{name:13} {about}\n{:13} {command}", "");
    }
    let mut stored = store::names(&store::folder())?;
    stored.retain(|name| RUNS.iter().all(|run| run.name != name));
    if !stored.is_empty() {
        println!("stored, but not measured by this program: {}", stored.join(", "));
    }
    Ok(())
}
