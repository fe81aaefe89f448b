//! The list of all benches.

use anyhow::{Context, Result};
use cosurf_tests::results::Results;
use tempfile::TempDir;

use crate::{benches, commands, devices, missions, truth};

/// A bench that `results` can run.
pub(crate) struct Run {
    /// Name of the bench and of its results.
    pub(crate) name: &'static str,
    /// The measured quantity, for `--list`.
    pub(crate) about: &'static str,
    /// The measuring command, with placeholders such as `DATA` for folders; shown below the table.
    pub(crate) command: &'static str,
    /// Runs the bench. The folder is temporary, and for any files that the bench writes.
    measure: fn(&TempDir) -> Result<Results>,
}

impl Run {
    /// Runs the bench.
    pub(crate) fn measure(&self) -> Result<Results> {
        let folder = tempfile::tempdir().context("a temporary folder")?;
        let results = (self.measure)(&folder)?;
        Ok(Results { name: self.name.to_owned(), command: self.command.to_owned(), ..results })
    }
}

/// What is wrong with the command of stored results, a sentence; `None` if nothing is. Results that name a source need
/// no bench.
pub(crate) fn command_fault(stored: &Results) -> Option<String> {
    let Results { name, command, .. } = stored;
    match RUNS.iter().find(|run| run.name == name) {
        Some(run) if run.command == command => None,
        Some(_) => {
            Some(format!("the results `{name}` are of an old command, `{command}`; measure them again"))
        }
        None if stored.source.is_some() => None,
        None => Some(format!("no bench measures the results `{name}`")),
    }
}

/// All benches, the quickest first.
pub(crate) const RUNS: [Run; 31] = [
    Run {
        name: "sizes",
        about: "size of both programs",
        command: "cargo build --release; cargo build --profile lean -p cosurf-agent [--no-default-features]",
        measure: commands::sizes,
    },
    Run {
        name: "serial",
        about: "goodput of the serial line over simulated radios",
        command: "results serial",
        measure: commands::serial,
    },
    Run {
        name: "truth",
        about: "how far the two true surfaces of rendered Boruszyn differ",
        command: "results truth",
        measure: truth::truth,
    },
    Run {
        name: "passes",
        about: "the passes of a training step, and whole steps",
        command: "cargo bench -p cosurf-engine --bench passes",
        measure: benches::passes,
    },
    Run {
        name: "mesh",
        about: "fusing depth to a mesh, and judging it",
        command: "cargo bench -p cosurf-aggregator --bench mesh",
        measure: benches::mesh,
    },
    Run {
        name: "packing",
        about: "bytes of a packed splat",
        command: "cargo bench -p cosurf-tests --bench layers -- MODEL.ply DATA --sh-degree N",
        measure: benches::packing,
    },
    Run {
        name: "crowd",
        about: "memory of an aggregator while two hundred agents upload",
        command: "cargo test --release -p cosurf-tests --test crowd -- --ignored",
        measure: benches::crowd,
    },
    Run {
        name: "short",
        about: "short trainings on real pictures",
        command: "cosurf-agent train DATA --max-size 320 --steps N",
        measure: commands::short,
    },
    Run {
        name: "defaults",
        about: "trainings and missions with nothing but defaults",
        command: "cosurf-agent train DATA; cosurf-aggregator mission",
        measure: commands::defaults,
    },
    Run {
        name: "seeds",
        about: "how far four seeds of one training differ",
        command: "cosurf-agent train DATA --seed N",
        measure: commands::seeds,
    },
    Run {
        name: "earlier",
        about: "trainings against those of an earlier version; hours",
        command: "cargo bench -p cosurf-tests --bench earlier -- --earlier AGENT --data DATA --max-size PX",
        measure: benches::earlier,
    },
    Run {
        name: "devices",
        about: "the same training on the CPU and on the GPU",
        command: "cosurf-agent train DATA --max-size 160 --steps 500 --device DEVICE; cosurf-aggregator merge DIR DIR \
                  --epochs 3 --device DEVICE",
        measure: devices::devices,
    },
    Run {
        name: "missions",
        about: "missions over real photographs against one model of all views",
        command: "cosurf-aggregator mission --data DATA --max-size 240 --steps 1000; cosurf-agent train DATA --max-size \
                  240 --steps 3200",
        measure: missions::missions,
    },
    Run {
        name: "placement",
        about: "how exactly models in wrong frames are placed",
        command: "cargo bench -p cosurf-tests --bench placement -- DATA AGENT...",
        measure: benches::placement,
    },
    Run {
        name: "frames",
        about: "what models in wrong frames cost",
        command: "cargo bench -p cosurf-tests --bench frames -- DATA AGENT...",
        measure: benches::frames,
    },
    Run {
        name: "fifth",
        about: "what the model of a fifth agent costs or gains",
        command: "cargo bench -p cosurf-tests --bench fifth -- DATA AGENT...",
        measure: benches::fifth,
    },
    Run {
        name: "seams",
        about: "whether a merge leaves seams where its tiles meet",
        command: "cargo bench -p cosurf-tests --bench seams -- DATA AGENT...",
        measure: benches::seams,
    },
    Run {
        name: "scale",
        about: "merges of sites with up to 256 devices",
        command: "cargo bench -p cosurf-tests --bench scale -- AGENT... --devices 16,64,256 --epochs 2 --pitch 1000 \
                  --memory 100MiB",
        measure: benches::scale,
    },
    Run {
        name: "budgets",
        about: "memory of commands with large inputs and small limits",
        command: "cargo bench -p cosurf-tests --bench budgets -- DATA SMALL AGENT...",
        measure: benches::budgets,
    },
    Run {
        name: "coordinates",
        about: "one scene at other places and in other units",
        command: "cargo bench -p cosurf-tests --bench coordinates -- DATA",
        measure: benches::coordinates,
    },
    Run {
        name: "workers",
        about: "how much faster two workers or two cores merge a large site",
        command: "cargo bench -p cosurf-tests --bench workers -- AGENT... --pitch 1000",
        measure: benches::workers,
    },
    Run {
        name: "lines",
        about: "uploads and downloads over slow lines that break",
        command: "cargo bench -p cosurf-tests --bench lines",
        measure: |folder| benches::ours("lines", &[], folder),
    },
    Run {
        name: "layers",
        about: "what is lost while a part of an upload is missing",
        command: "cargo bench -p cosurf-tests --bench layers -- MODEL.ply DATA --sh-degree 2 --max-size 240",
        measure: benches::layers,
    },
    Run {
        name: "broken_off",
        about: "what a global model loses if uploads break off",
        command: "cargo bench -p cosurf-tests --bench broken_off -- DATA AGENT...",
        measure: benches::broken_off,
    },
    Run {
        name: "geometry",
        about: "what the losses of the surface bring and cost",
        command: "cargo bench -p cosurf-tests --bench geometry",
        measure: |folder| benches::ours("geometry", &[], folder),
    },
    Run {
        name: "geometry_480",
        about: "the same at the pictures' own size",
        command: "cargo bench -p cosurf-tests --bench geometry -- --max-size 480",
        measure: |folder| benches::ours("geometry", &["--max-size", "480"], folder),
    },
    Run {
        name: "geometry_city",
        about: "the same for the built-in city",
        command: "cargo bench -p cosurf-tests --bench geometry -- --data CITY --max-size 320",
        measure: benches::geometry_city,
    },
    Run {
        name: "paper",
        about: "ours against the paper's settings, each on its own",
        command: "cargo bench -p cosurf-tests --bench paper",
        measure: |folder| benches::ours("paper", &[], folder),
    },
    Run {
        name: "poses",
        about: "trainings whose poses are not exact",
        command: "cargo bench -p cosurf-tests --bench poses -- --data DATA",
        measure: benches::poses,
    },
    Run {
        name: "prune",
        about: "what pruning costs",
        command: "cargo bench -p cosurf-tests --bench prune",
        measure: |folder| benches::ours("prune", &[], folder),
    },
    Run {
        name: "merging",
        about: "many models to one; hours on one core",
        command: "taskset -c 0 cargo bench -p cosurf-tests --bench merging -- --max-size 160 --lpips WEIGHTS",
        measure: benches::merging,
    },
];

#[cfg(test)]
mod tests {
    use cosurf_tests::results::store;

    use super::*;

    #[test]
    fn stored_results_have_the_commands_of_their_benches() -> Result<()> {
        let stored = store::read_all(&store::folder())?;
        let faults: Vec<String> = stored.iter().filter_map(command_fault).collect();
        assert!(faults.is_empty(), "{}", faults.join("\n"));
        Ok(())
    }

    #[test]
    fn other_commands_and_unknown_results_are_found() {
        let has_fault = |name: &str, command: &str, source: Option<&str>| {
            let (name, command, source) = (name.to_owned(), command.to_owned(), source.map(str::to_owned));
            command_fault(&Results { name, command, source, ..Results::default() }).is_some()
        };
        assert!(!has_fault("truth", "results truth", None));
        assert!(has_fault("truth", "results truth --fast", None));
        assert!(has_fault("truth", "results truth --fast", Some("README")));
        assert!(has_fault("opensplat", "OpenSplat DATA", None));
        assert!(!has_fault("opensplat", "OpenSplat DATA", Some("README")));
    }
}
