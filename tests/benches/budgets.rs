//! Measures the memory of commands that were given a limit, from outside, with inputs that are large for it.
//!
//! `cargo bench -p cosurf-tests --bench budgets -- --help`
//!
//! A command keeps its limit, or refuses it and names one that it keeps. Anything else fails the bench.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use clap::Parser;
use cosurf_scene::{Camera, Dataset, LocalFrame, Picture, SparsePoint, Splats, camera_list, colmap, ply};
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use cosurf_tests::usage::watch;
use glam::DVec3;

const MIB: u64 = 1 << 20;
/// The limits, MiB.
const LIMITS_MIB: [u64; 4] = [64, 100, 300, 1000];
/// Long side of the large pictures, px: those of a camera with 20 megapixels, or a few more.
const LARGE_PX: u32 = 5472;
/// Number of points of the large cloud.
const POINTS: usize = 2_000_000;
/// Number of splats of the large model, and of the one that is surveyed.
const SPLATS: usize = 1_400_000;
const SURVEYED: usize = 2_000_000;
/// Training steps. The largest buffers are there from the first step on.
const STEPS: &str = "30";

/// Measure the memory of commands. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// A dataset with pictures of their full size
    data: PathBuf,
    /// A dataset of few small pictures, which are enlarged
    small: PathBuf,
    /// The folders of agents whose models are merged
    #[arg(required = true)]
    agents: Vec<PathBuf>,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

/// A command and what it is given, except for its limit.
struct Case {
    name: &'static str,
    program: &'static str,
    words: Vec<String>,
    /// The options that take the limit.
    limits: &'static [&'static str],
    /// A folder that must not be there when the command begins.
    fresh: Option<PathBuf>,
}

const MEMORY: &[&str] = &["--memory"];

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let temporary = tempfile::tempdir()?;
    let peak = |limit| {
        Column::new(&format!("within {limit} MiB"), "MiB", 0).guarded(Better::Lower, Tolerance::Relative(0.2))
    };
    let least = Column::new("needed otherwise", "MiB", 0);
    let columns: Vec<Column> = LIMITS_MIB.into_iter().map(peak).chain([least]).collect();
    let mut measurement = Measurement::start("budgets", &columns);
    for case in cases(&arguments, temporary.path())? {
        let (mut figures, mut least_mib) = (Vec::new(), None);
        for limit_mib in LIMITS_MIB {
            match case.run(limit_mib)? {
                Outcome::Kept(peak_bytes) => figures.push(Some(peak_bytes as f64 / MIB as f64)),
                Outcome::Refused(needed_mib) => {
                    figures.push(None);
                    least_mib.get_or_insert(needed_mib);
                }
            }
        }
        figures.push(least_mib);
        measurement.row(case.name, &figures);
    }
    measurement.finish()?;
    Ok(())
}

/// What a command did with its limit.
enum Outcome {
    /// It stayed at this peak, bytes.
    Kept(u64),
    /// It named another one, MiB.
    Refused(f64),
}

impl Case {
    fn run(&self, limit_mib: u64) -> Result<Outcome> {
        let Self { name, words, limits, fresh, .. } = self;
        if let Some(folder) = fresh.as_ref().filter(|folder| folder.exists()) {
            fs::remove_dir_all(folder)?;
        }
        let mut command = Command::new(program(self.program));
        let limit = format!("{limit_mib}MiB");
        command.args(words).args(limits.iter().flat_map(|option| [*option, &limit]));
        let log = tempfile::NamedTempFile::new()?;
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log.reopen()?);
        let usage = watch(&mut command.spawn()?);
        let peak_bytes = usage.peak_bytes.max(usage.largest_child_bytes);
        let told = fs::read_to_string(log.path())?;
        ensure!(peak_bytes <= limit_mib * MIB, "{name}: {} MiB within {limit_mib}: {told}", peak_bytes / MIB);
        if usage.succeeded {
            return Ok(Outcome::Kept(peak_bytes));
        }
        let needed = needed_mib(&told).with_context(|| format!("{name} within {limit_mib} MiB: {told}"))?;
        Ok(Outcome::Refused(needed))
    }
}

/// The limit that a refusal asks for, MiB.
fn needed_mib(told: &str) -> Option<f64> {
    let after = |marker: &str| -> Option<f64> {
        let rest = told.rsplit_once(marker)?.1;
        let (number, _) = rest.split_once("MiB")?;
        number.trim().parse().ok()
    };
    ["--memory ", "at least ", "needs "].into_iter().find_map(after)
}

fn cases(arguments: &Arguments, folder: &Path) -> Result<Vec<Case>> {
    let Arguments { data, small, agents, .. } = arguments;
    let text = |path: &Path| path.display().to_string();
    let out = text(&folder.join("out"));
    let train = |name, data: &Path, init: Option<&Path>| {
        let mut words = vec!["train".into(), text(data), "--out".into(), out.clone(), "--fresh".into()];
        words.extend(["--steps", STEPS, "--compute", "cpu"].map(String::from));
        words.extend(init.into_iter().flat_map(|init| ["--init".into(), text(init)]));
        Case { name, program: "cosurf-agent", words, limits: MEMORY, fresh: None }
    };
    let (jpegs, pngs) =
        (enlarged(small, &folder.join("jpeg"), "jpg")?, enlarged(small, &folder.join("png"), "png")?);
    let points = with_points(data, &folder.join("points"))?;
    let model = large_model(data, &folder.join("large.ply"), SPLATS)?;
    let merged = text(&folder.join("merged"));
    let mut merge = vec!["merge".into(), "--out".into(), merged, "--compute".into(), "cpu".into()];
    merge.extend(agents.iter().map(|agent| text(agent)));
    let mesh = [
        "mesh".into(),
        text(&agents[0]),
        "--cameras".into(),
        text(data),
        "--out".into(),
        out.clone() + ".ply",
    ];
    // Few views of a large model; an option that is empty is none.
    let view = |name, command: &str, option: &str| {
        let mut words = vec![command.to_owned(), text(&model)];
        words.extend((!option.is_empty()).then(|| option.to_owned()));
        words.push(text(data));
        words.extend(["--max-size", "320", "--compute", "cpu"].map(String::from));
        words.extend(if command == "render" { vec!["--out".into(), out.clone()] } else { Vec::new() });
        Case { name, program: "cosurf-agent", words, limits: MEMORY, fresh: None }
    };
    let aggregator =
        |name, words| Case { name, program: "cosurf-aggregator", words, limits: MEMORY, fresh: None };
    let fresh = folder.join("mission");
    let mission = ["mission", "--data", &text(data), "--out", &text(&fresh), "--steps", STEPS];
    let mission = Case {
        limits: &["--memory", "--merge-memory"],
        fresh: Some(fresh),
        ..aggregator("mission, the largest of its processes", mission.map(String::from).to_vec())
    };
    let convert = ["convert".into(), text(&model), out.clone() + ".spz"];
    let largest = large_model(data, &folder.join("largest.ply"), SURVEYED)?;
    let surveyed = with_cameras(data, &largest, &folder.join("surveyed"))?;
    let survey = ["survey".into(), text(&surveyed), "--out".into(), text(&folder.join("survey"))];
    let survey = survey.into_iter().chain(["--origin".into(), "53.3,16.4,0".into()]).collect();
    Ok(vec![
        train("train, photographs of their full size", data, None),
        train("train, JPEGs of 20 megapixels", &jpegs, None),
        train("train, PNGs of 20 megapixels", &pngs, None),
        train("train, 2 million sparse points", &points, None),
        train("train, 1.4 million splats to begin with", data, Some(&model)),
        aggregator("merge, four models", merge),
        aggregator("mesh, one model", mesh.to_vec()),
        view("render, 1.4 million splats", "render", "--cameras"),
        view("eval, 1.4 million splats", "eval", ""),
        aggregator("convert, 1.4 million splats", convert.to_vec()),
        aggregator("survey, 2 million splats", survey),
        mission,
    ])
}

/// The same dataset with pictures of [`LARGE_PX`] or a little more.
fn enlarged(small: &Path, folder: &Path, extension: &str) -> Result<PathBuf> {
    let mut dataset = Dataset::open(small)?;
    fs::create_dir_all(folder.join("images"))?;
    for view in &mut dataset.views {
        let picture = Picture::read(&view.path)?;
        let times = LARGE_PX.div_ceil(picture.size_px[0].max(picture.size_px[1]));
        let large = picture.resized(picture.size_px.map(|side| side * times));
        view.camera = view.camera.resized(large.size_px);
        view.name = format!("{}.{extension}", view.name);
        view.path = folder.join("images").join(&view.name);
        match extension {
            "png" => large.write_png(&view.path)?,
            _ => large.write_jpeg(&view.path, 90)?,
        }
    }
    colmap::write(folder, &dataset)?;
    Ok(folder.to_owned())
}

/// The same dataset with [`POINTS`] sparse points: its own, again and again, each time a little farther off.
fn with_points(data: &Path, folder: &Path) -> Result<PathBuf> {
    let mut dataset = Dataset::open(data)?;
    let own = std::mem::take(&mut dataset.points);
    ensure!(!own.is_empty(), "{}: has no sparse points", data.display());
    let shifted = |i: usize| {
        let SparsePoint { position, rgb, views } = own[i % own.len()].clone();
        SparsePoint { position: position + DVec3::splat(1e-3 * (i / own.len()) as f64), rgb, views }
    };
    dataset.points = (0..POINTS).map(shifted).collect();
    fs::create_dir_all(folder)?;
    std::os::unix::fs::symlink(fs::canonicalize(data)?.join("images"), folder.join("images"))?;
    colmap::write(folder, &dataset)?;
    Ok(folder.to_owned())
}

/// A model of so many splats at the sparse points of a dataset.
fn large_model(data: &Path, path: &Path, splats: usize) -> Result<PathBuf> {
    let points = Dataset::open(data)?.points;
    ensure!(!points.is_empty(), "{}: has no sparse points", data.display());
    let mut model = Splats::with_capacity(splats, 3);
    for i in 0..splats {
        let at = points[i % points.len()].position + DVec3::splat(1e-3 * (i / points.len()) as f64);
        model.push(at.as_vec3().to_array(), [1.0, 0.0, 0.0, 0.0], [-3.0; 3], 1.0, &[0.1; 48]);
    }
    ply::write(path, &model, &LocalFrame::WORLD)?;
    Ok(path.to_owned())
}

/// A folder of a model in a file, with the cameras of a dataset.
fn with_cameras(data: &Path, model: &Path, folder: &Path) -> Result<PathBuf> {
    fs::create_dir_all(folder)?;
    std::os::unix::fs::symlink(model, folder.join("model.ply"))?;
    let cameras: Vec<Camera> = Dataset::open(data)?.views.iter().map(|view| view.camera).collect();
    camera_list::write(&folder.join(camera_list::FILE), &cameras)?;
    Ok(folder.to_owned())
}
