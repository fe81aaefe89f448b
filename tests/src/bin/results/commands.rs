//! Runs the two programs as a user runs them, and measures them. Also measures the simulated serial line.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cosurf_tests::datasets::shared_dataset;
use cosurf_tests::programs::program;
use cosurf_tests::radio::goodput;
use cosurf_tests::results::{Better, Column, Measurement, Results, Tolerance, machine};
use serde_json::Value;
use tempfile::TempDir;

pub(crate) const MIB: f64 = (1 << 20) as f64;

/// The folder of a dataset in `../shared/data`, relative to the checkout. Fails if it does not exist.
pub(crate) fn dataset(name: &str) -> Result<PathBuf> {
    shared_dataset(name).with_context(|| format!("../shared/data/{name} is missing"))
}

/// Builds both programs.
pub(crate) fn build() -> Result<()> {
    // Together with a bench, so that dependencies have the features that benches need and are not compiled again for them.
    let programs = ["build", "--release", "--locked", "--workspace", "--bins", "--bench", "lines"];
    succeed(Command::new("cargo").args(programs).current_dir(machine::root()))
}

/// Runs a command and ignores its standard output. Fails if the command fails.
pub(crate) fn succeed(command: &mut Command) -> Result<()> {
    let status = command.stdin(Stdio::null()).stdout(Stdio::null()).status();
    let status = status.with_context(|| format!("{command:?}"))?;
    ensure!(status.success(), "{command:?}: {status}");
    Ok(())
}

/// Runs a command with the option `--json`, and parses its output.
fn json(command: &mut Command) -> Result<Value> {
    let output = command.arg("--json").stdin(Stdio::null()).output();
    let output = output.with_context(|| format!("{command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// The time and the report of a training or a mission.
pub(crate) struct Outcome {
    /// Wall time of the command.
    seconds: f64,
    report: Value,
}

impl Outcome {
    /// The number at a JSON pointer in `report.json`, for example `/psnr`; `None` if there is no number.
    pub(crate) fn figure(&self, pointer: &str) -> Option<f64> {
        self.report.pointer(pointer).and_then(Value::as_f64)
    }
}

/// Runs `cosurf-agent train DATA` with options.
pub(crate) fn train(data: &Path, options: &[&str], out: &Path) -> Result<Outcome> {
    let mut command = Command::new(program("cosurf-agent"));
    run(command.arg("train").arg(data).args(options), out)
}

/// Runs `cosurf-aggregator mission` with options, on the built-in city if `data` is `None`.
pub(crate) fn mission(data: Option<&Path>, options: &[&str], out: &Path) -> Result<Outcome> {
    let mut command = Command::new(program("cosurf-aggregator"));
    command.arg("mission").args(options);
    if let Some(data) = data {
        command.arg("--data").arg(data);
    }
    run(&mut command, out)
}

/// The folders of the agents of a mission.
pub(crate) fn agents(mission: &Path, count: usize) -> Vec<PathBuf> {
    (1..=count).map(|i| mission.join(format!("agents/agent-{i}"))).collect()
}

/// `cosurf-aggregator merge` with options; returns what it prints as JSON.
pub(crate) fn merge(models: &[PathBuf], options: &[&str], out: &Path) -> Result<Value> {
    let mut command = Command::new(program("cosurf-aggregator"));
    json(command.arg("merge").args(models).args(options).arg("--out").arg(out))
}

/// `cosurf-aggregator eval` with options; returns what it prints as JSON.
pub(crate) fn evaluate(model: &Path, data: &Path, options: &[&str]) -> Result<Value> {
    let mut command = Command::new(program("cosurf-aggregator"));
    json(command.arg("eval").arg(model).arg(data).args(options))
}

fn run(command: &mut Command, out: &Path) -> Result<Outcome> {
    let begun = Instant::now();
    succeed(command.arg("--out").arg(out))?;
    let seconds = begun.elapsed().as_secs_f64();
    Ok(Outcome { seconds, report: serde_json::from_slice(&fs::read(out.join("report.json"))?)? })
}

/// Measures the sizes of both programs, and of the agent as built for drones (profile `lean`), each with and without
/// symbols.
pub(crate) fn sizes(folder: &TempDir) -> Result<Results> {
    build()?;
    let size =
        |name, decimals| Column::new(name, "MiB", decimals).guarded(Better::Lower, Tolerance::Relative(0.05));
    let mut measurement = Measurement::start("sizes", &[size("as built", 1), size("stripped", 1)]);
    let mut row = |name: &str, built: &Path| -> Result<()> {
        let stripped = folder.path().join("stripped");
        succeed(Command::new("strip").arg("-o").arg(&stripped).arg(built))?;
        let mib = |path: &Path| Ok::<_, std::io::Error>(Some(fs::metadata(path)?.len() as f64 / MIB));
        measurement.row(name, &[mib(built)?, mib(&stripped)?]);
        Ok(())
    };
    for name in ["cosurf-agent", "cosurf-aggregator"] {
        row(&format!("`{name}`"), &program(name))?;
    }
    let lean = machine::root().join("target/lean/cosurf-agent");
    for (name, options) in [
        ("`cosurf-agent`, profile `lean`", &[][..]),
        ("the same, without graphics cards", &["--no-default-features"]),
    ] {
        let mut command = Command::new("cargo");
        command.args(["build", "--locked", "--profile", "lean", "-p", "cosurf-agent"]).args(options);
        succeed(command.current_dir(machine::root()))?;
        row(name, &lean)?;
    }
    Ok(measurement.finish()?)
}

/// Measures the goodput of a simulated radio: the share of its bandwidth that carries payload, as the mean of 20 seeds.
pub(crate) fn serial(_: &TempDir) -> Result<Results> {
    let share =
        Column::new("goodput", "share of the rate", 2).guarded(Better::Higher, Tolerance::Absolute(0.01));
    let mut measurement = Measurement::start("serial", &[share]);
    for (name, loss) in [("no loss", 0.0), ("5 % of the frames lost", 0.05), ("20 % of the frames lost", 0.2)]
    {
        let sum: f64 = (0..20).map(|seed| goodput(seed, loss, 1 << 20).0).sum();
        measurement.row(name, &[Some(sum / 20.0)]);
    }
    Ok(measurement.finish()?)
}

/// Measures PSNR and SSIM of held-out views after few steps.
pub(crate) fn short(folder: &TempDir) -> Result<Results> {
    build()?;
    let mut measurement = Measurement::start("short", &[Column::psnr("PSNR"), Column::ssim()]);
    for (name, data, options) in [
        ("Boruszyn, 300 steps", "real_boruszyn", &["--steps", "300"][..]),
        ("Boruszyn, 600 steps", "real_boruszyn", &["--steps", "600"]),
        ("Boruszyn, 1,000 steps", "real_boruszyn", &["--steps", "1000"]),
        ("Boruszyn, 1,000 steps, `--color-only`", "real_boruszyn", &["--steps", "1000", "--color-only"]),
        ("Caliterra, 300 steps", "real_caliterra", &["--steps", "300"]),
        ("Caliterra, 600 steps", "real_caliterra", &["--steps", "600"]),
    ] {
        let options = [&["--max-size", "320"], options].concat();
        let outcome = train(&dataset(data)?, &options, &folder.path().join(name))?;
        measurement.row(name, &[outcome.figure("/psnr"), outcome.figure("/ssim")]);
    }
    Ok(measurement.finish()?)
}

/// Measures time, memory and quality of trainings and missions with default options. The time of a mission includes
/// rendering the pictures of the built-in city and writing the report. The memory of a mission is that of its largest
/// agent.
pub(crate) fn defaults(folder: &TempDir) -> Result<Results> {
    build()?;
    let time = Column::speed("time", "s", 0, Better::Lower);
    let columns = [time, Column::memory(), Column::splats(), Column::psnr("PSNR"), Column::ssim()];
    let mut measurement = Measurement::start("defaults", &columns);
    let mut row = |name: &str, outcome: &Outcome, figures: [&str; 4]| {
        let [memory, splats, psnr, ssim] = figures.map(|pointer| outcome.figure(pointer));
        measurement.row(name, &[Some(outcome.seconds), memory.map(|bytes| bytes / MIB), splats, psnr, ssim]);
    };
    let of_agent = ["/peak_memory_bytes", "/splats", "/psnr", "/ssim"];
    let of_mission =
        ["/whole/peak_memory_bytes", "/whole/splats", "/whole/quality/psnr", "/whole/quality/ssim"];
    let [boruszyn, caliterra] = [dataset("real_boruszyn")?, dataset("real_caliterra")?];
    let out = |name: &str| folder.path().join(name);
    row("Boruszyn, 478 × 640, `train`", &train(&boruszyn, &[], &out("boruszyn"))?, of_agent);
    row("Caliterra, 640 × 481, `train`", &train(&caliterra, &[], &out("caliterra"))?, of_agent);
    row("Caliterra, 640 × 481, `mission`", &mission(Some(&caliterra), &[], &out("mission"))?, of_mission);
    row("the built-in city, 320 × 240, `mission`", &mission(None, &[], &out("city"))?, of_mission);
    Ok(measurement.finish()?)
}

/// Measures the lowest and the highest PSNR of one training with four seeds.
pub(crate) fn seeds(folder: &TempDir) -> Result<Results> {
    build()?;
    let boruszyn = dataset("real_boruszyn")?;
    let mut measurement = Measurement::start("seeds", &[Column::psnr("lowest"), Column::psnr("highest")]);
    let psnr = |seed: &str| -> Result<f64> {
        let outcome = train(&boruszyn, &["--seed", seed], &folder.path().join(seed))?;
        outcome.figure("/psnr").context("no PSNR in the report")
    };
    let psnrs = ["0", "1", "2", "3"].iter().map(|seed| psnr(seed)).collect::<Result<Vec<f64>>>()?;
    let [lowest, highest] = [psnrs.iter().copied().reduce(f64::min), psnrs.iter().copied().reduce(f64::max)];
    measurement.row("Boruszyn, 478 × 640, four seeds", &[lowest, highest]);
    Ok(measurement.finish()?)
}
