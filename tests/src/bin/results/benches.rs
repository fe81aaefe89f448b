//! The benches that cargo runs: benches of all crates, and ignored tests that measure.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use cosurf_tests::datasets::write_city;
use cosurf_tests::results::{Better, Column, Measurement, Results, Tolerance, machine, store};
use tempfile::TempDir;

use crate::commands::{agents, build, dataset, mission, succeed, train};
use crate::divan;

/// Datasets of the upload benches: the name in tables, and the folder; `None` generates the built-in city.
const DATASETS: [(&str, Option<&str>); 4] = [
    ("Boruszyn", Some("real_boruszyn")),
    ("Caliterra", Some("real_caliterra")),
    ("rendered Boruszyn", Some("gt_boruszyn")),
    ("the built-in city", None),
];
/// The commit of version 0.1, with which trainings are compared.
const EARLIER: &str = "1fbfbc3";
/// Training options of the models that are uploaded.
pub(crate) const TRAINING: [&str; 4] = ["--max-size", "240", "--steps", "1000"];

/// A bench, compiled with the features of the whole workspace, as [`build`] compiles the programs: nothing is compiled twice.
fn cargo_bench(bench: &str, words: &[&str]) -> Command {
    let mut command = Command::new("cargo");
    command.args(["bench", "--locked", "--workspace", "--bench", bench, "--"]).args(words);
    command.current_dir(machine::root()).stdin(Stdio::null());
    command
}

/// Runs a bench of this package. The bench writes its results into `folder`.
pub(crate) fn ours(bench: &str, words: &[&str], folder: &TempDir) -> Result<Results> {
    read_after(&mut cargo_bench(bench, words), bench, folder)
}

/// Measures the memory of an aggregator to which two hundred agents upload, by an ignored test.
pub(crate) fn crowd(folder: &TempDir) -> Result<Results> {
    build()?;
    let mut command = Command::new("cargo");
    command
        .args(["test", "--release", "--locked", "--workspace", "--test", "crowd", "--", "--ignored"])
        .current_dir(machine::root())
        .stdin(Stdio::null());
    read_after(&mut command, "crowd", folder)
}

fn read_after(command: &mut Command, bench: &str, folder: &TempDir) -> Result<Results> {
    let status = command.env("RESULTS_FOLDER", folder.path()).status()?;
    ensure!(status.success(), "{bench}: {status}");
    store::read(folder.path(), bench)?.with_context(|| format!("{bench} wrote no results"))
}

/// Runs a bench that uses the library divan, and parses its output. `decimals` are the digits after the point of time
/// and throughput in tables.
fn by_divan(bench: &str, decimals: [usize; 2]) -> Result<Results> {
    let output = cargo_bench(bench, &[]).stderr(Stdio::inherit()).output()?;
    ensure!(output.status.success(), "{bench}: {}", output.status);
    let columns = [
        Column::speed("time", "ms", decimals[0], Better::Lower),
        Column::speed("throughput", "million items/s", decimals[1], Better::Higher),
    ];
    let mut measurement = Measurement::start(bench, &columns);
    let rows = divan::rows(&String::from_utf8_lossy(&output.stdout));
    ensure!(!rows.is_empty(), "{bench} printed no figures");
    for divan::Fastest { name, ms, million_per_s } in rows {
        measurement.row(&name, &[Some(ms), million_per_s]);
    }
    Ok(measurement.finish()?)
}

/// Measures the passes of a training step.
pub(crate) fn passes(_: &TempDir) -> Result<Results> {
    by_divan("passes", [2, 1])
}

/// Measures how fast a mesh is fused from depth, and how fast it is scored.
pub(crate) fn mesh(_: &TempDir) -> Result<Results> {
    by_divan("mesh", [0, 2])
}

/// Measures gain and cost of the surface losses on the built-in city.
pub(crate) fn geometry_city(folder: &TempDir) -> Result<Results> {
    let city = folder.path().join("city");
    write_city(&city, 180.0, 96, [320, 240]);
    ours("geometry", &["--data", text(&city)?, "--max-size", "320"], folder)
}

/// Measures merging, with all processes on the same core.
pub(crate) fn merging(folder: &TempDir) -> Result<Results> {
    build()?;
    let weights = machine::root().join("../shared/lpips");
    let bench = cargo_bench("merging", &["--max-size", "160", "--lpips", text(&weights)?]);
    let mut pinned = Command::new("taskset");
    pinned.args(["-c", "0"]).arg(bench.get_program()).args(bench.get_args()).current_dir(machine::root());
    read_after(&mut pinned, "merging", folder)
}

/// Compares trainings with those of the commit [`EARLIER`], on pictures with a long side of at most 640 px.
pub(crate) fn earlier(folder: &TempDir) -> Result<Results> {
    build()?;
    let agent = earlier_agent()?;
    of_each_dataset("earlier", folder, |name, data, _| {
        let words = ["--earlier", text(&agent)?, "--data", text(data)?, "--name", name, "--max-size", "640"];
        ours("earlier", &words, folder)
    })
}

/// Builds the agent of the commit [`EARLIER`] in a clone of the repository, `target/earlier`. Returns the path of the program.
fn earlier_agent() -> Result<PathBuf> {
    let clone = machine::root().join("target/earlier");
    if !clone.exists() {
        succeed(Command::new("git").args(["clone", "--quiet"]).arg(machine::root()).arg(&clone))?;
    }
    succeed(Command::new("git").args(["checkout", "--quiet", EARLIER]).current_dir(&clone))?;
    let build = ["build", "--release", "--locked", "-p", "cosurf-agent"];
    succeed(Command::new("cargo").args(build).env("CARGO_TARGET_DIR", "target").current_dir(&clone))?;
    Ok(clone.join("target/release/cosurf-agent"))
}

/// Measures trainings with poses that are not exact, on Caliterra and on rendered Boruszyn.
pub(crate) fn poses(folder: &TempDir) -> Result<Results> {
    build()?;
    of_datasets(&DATASETS[1..3], "poses", folder, |name, data, _| {
        ours("poses", &["--data", text(data)?, "--name", name], folder)
    })
}

/// Measures partial uploads of a trained model, for each dataset.
pub(crate) fn layers(folder: &TempDir) -> Result<Results> {
    build()?;
    of_each_dataset("layers", folder, |name, data, out| {
        train(data, &TRAINING, out)?;
        let model = out.join("model.ply");
        let words = [text(&model)?, text(data)?, "--sh-degree", "2", "--max-size", "240", "--name", name];
        ours("layers", &words, folder)
    })
}

/// Measures the bytes of a packed splat.
pub(crate) fn packing(folder: &TempDir) -> Result<Results> {
    build()?;
    let (data, out) = (dataset("real_caliterra")?, folder.path().join("caliterra"));
    train(&data, &TRAINING, &out)?;
    let model = out.join("model.ply");
    let bytes =
        |name| Column::new(name, "bytes a splat", 2).guarded(Better::Lower, Tolerance::Relative(0.02));
    let mut measurement = Measurement::start("packing", &[bytes("packed"), bytes("as 32-bit floats")]);
    for degree in [3, 2] {
        let words = [text(&model)?, text(&data)?, "--sh-degree", &degree.to_string(), "--max-size", "240"];
        let packed = ours("layers", &words, folder)?.figure("model", "bytes a splat");
        // Mean, rotation, scales and opacity; then three colours of all harmonics.
        let numbers = 3 + 4 + 3 + 1 + 3 * (degree + 1) * (degree + 1);
        measurement.row(&format!("degree {degree}"), &[packed, Some(f64::from(4 * numbers))]);
    }
    Ok(measurement.finish()?)
}

/// Measures missions whose uploads break off, for each dataset.
pub(crate) fn broken_off(folder: &TempDir) -> Result<Results> {
    of_missions(&DATASETS, "broken_off", |_| (&TRAINING, &[]), folder)
}

/// Measures missions whose models arrive in frames that are not exactly right.
pub(crate) fn frames(folder: &TempDir) -> Result<Results> {
    of_missions(&DATASETS[2..], "frames", |_| (&TRAINING, &["--seeds", "20"]), folder)
}

/// Measures missions that a fifth agent joins.
pub(crate) fn fifth(folder: &TempDir) -> Result<Results> {
    of_missions(&DATASETS[2..], "fifth", |_| (&TRAINING, &[]), folder)
}

/// Measures whether merges leave seams where their tiles meet.
pub(crate) fn seams(folder: &TempDir) -> Result<Results> {
    of_missions(&DATASETS[1..], "seams", |_| (&TRAINING, &[]), folder)
}

/// Measures merges of sites that are made of a mission over Caliterra, again and again. The districts are so far apart
/// that none sees another.
pub(crate) fn scale(folder: &TempDir) -> Result<Results> {
    of_districts("scale", &["--devices", "16,64,256", "--epochs", "2", "--memory", "100MiB"], folder)
}

/// Measures the memory of commands within limits, with large inputs.
pub(crate) fn budgets(folder: &TempDir) -> Result<Results> {
    build()?;
    let (data, small, out) =
        (dataset("real_caliterra")?, dataset("gt_tiny")?, folder.path().join("caliterra"));
    mission(Some(&data), &[&TRAINING[..], &["--agents", "4"]].concat(), &out)?;
    let inputs = [data, small].into_iter().chain(agents(&out, 4));
    let inputs = inputs.map(|input| text(&input).map(str::to_owned)).collect::<Result<Vec<_>>>()?;
    ours("budgets", &inputs.iter().map(String::as_str).collect::<Vec<_>>(), folder)
}

/// Measures a scene at other places and in other units.
pub(crate) fn coordinates(folder: &TempDir) -> Result<Results> {
    build()?;
    let data = dataset("real_caliterra")?;
    ours("coordinates", &[text(&data)?], folder)
}

/// Measures how much faster two workers merge a site of such districts.
pub(crate) fn workers(folder: &TempDir) -> Result<Results> {
    of_districts("workers", &[], folder)
}

/// Runs a bench on sites that are made of a mission over Caliterra.
fn of_districts(bench: &str, options: &[&str], folder: &TempDir) -> Result<Results> {
    build()?;
    let (data, out) = (dataset("real_caliterra")?, folder.path().join("caliterra"));
    mission(Some(&data), &[&TRAINING[..], &["--agents", "4"]].concat(), &out)?;
    let agents = agents(&out, 4);
    let agents = agents.iter().map(|agent| text(agent)).collect::<Result<Vec<_>>>()?;
    ours(bench, &[&agents[..], options, &["--pitch", "1000"]].concat(), folder)
}

/// Measures where models that arrive in wrong frames are placed. Most cases are of the city, with the defaults of a
/// mission.
pub(crate) fn placement(folder: &TempDir) -> Result<Results> {
    let options = |name: &str| -> Options {
        if name == "the built-in city" { (&[], &["--seeds", "100"]) } else { (&TRAINING, &["--seeds", "20"]) }
    };
    of_missions(&DATASETS[1..], "placement", options, folder)
}

/// Options of a mission, and of the bench that measures it.
type Options = (&'static [&'static str], &'static [&'static str]);

/// Runs a bench for a mission of four agents over each dataset, and joins the rows. `options` gets the name of the
/// dataset.
fn of_missions(
    datasets: &[(&str, Option<&str>)],
    bench: &str,
    options: impl Fn(&str) -> Options,
    folder: &TempDir,
) -> Result<Results> {
    build()?;
    of_datasets(datasets, bench, folder, |name, data, out| {
        let (of_mission, of_bench) = options(name);
        mission(Some(data), &[of_mission, &["--agents", "4"]].concat(), out)?;
        let agents = agents(out, 4);
        let agents = agents.iter().map(|agent| text(agent)).collect::<Result<Vec<_>>>()?;
        ours(bench, &[&[text(data)?, "--name", name], of_bench, &agents[..]].concat(), folder)
    })
}

/// Runs a bench for each dataset, and joins the rows.
fn of_each_dataset(
    bench: &str,
    folder: &TempDir,
    run: impl FnMut(&str, &Path, &Path) -> Result<Results>,
) -> Result<Results> {
    of_datasets(&DATASETS, bench, folder, run)
}

fn of_datasets(
    datasets: &[(&str, Option<&str>)],
    bench: &str,
    folder: &TempDir,
    mut run: impl FnMut(&str, &Path, &Path) -> Result<Results>,
) -> Result<Results> {
    let mut all: Option<Results> = None;
    for &(name, data) in datasets {
        let data = match data {
            Some(data) => dataset(data)?,
            None => {
                let city = folder.path().join("city");
                write_city(&city, 180.0, 96, [320, 240]);
                city
            }
        };
        let results = run(name, &data, &folder.path().join(name))?;
        match &mut all {
            Some(all) => all.rows.extend(results.rows),
            None => all = Some(results),
        }
    }
    all.with_context(|| format!("{bench} has no datasets"))
}

pub(crate) fn text(path: &Path) -> Result<&str> {
    path.to_str().with_context(|| format!("{} is not UTF-8", path.display()))
}
