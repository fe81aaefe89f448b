//! Tests of the agent's command line. Training gives the same bytes for any number of threads and after a kill. It
//! keeps the memory limit. Each fault of the input gives one clear line.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use cosurf_scene::bytes::parse_bytes;
use cosurf_scene::{Dataset, LocalFrame, Splats, colmap, ply};
use cosurf_tests::datasets::write_city;
use cosurf_tests::programs::program;
use cosurf_tests::skips::skip;
use cosurf_tests::usage::watch;
use tempfile::TempDir;

/// The folder of a dataset of a small synthetic city, rendered once for all tests of this file.
fn city() -> &'static Path {
    static CITY: OnceLock<TempDir> = OnceLock::new();
    CITY.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        write_city(folder.path(), 40.0, 12, [96, 72]);
        folder
    })
    .path()
}

/// A copy of the city that a test may change.
fn copy_of_city() -> TempDir {
    fn copy(from: &Path, to: &Path) {
        fs::create_dir_all(to).unwrap();
        for entry in fs::read_dir(from).unwrap() {
            let entry = entry.unwrap();
            let target = to.join(entry.file_name());
            if entry.file_type().unwrap().is_dir() {
                copy(&entry.path(), &target);
            } else {
                fs::copy(entry.path(), target).unwrap();
            }
        }
    }
    let folder = tempfile::tempdir().unwrap();
    copy(city(), folder.path());
    folder
}

fn agent(words: &[&str]) -> Command {
    let mut command = Command::new(program("cosurf-agent"));
    command.args(words).stdin(Stdio::null());
    command
}

fn train(data: &Path, out: &Path, words: &[&str]) -> Command {
    let mut command = agent(&["train"]);
    command.arg(data).arg("--out").arg(out).args(words);
    command
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn succeed(mut command: Command) {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
}

/// Runs a command that must fail. It must print exactly one line that begins with the program's name, and this line
/// must contain all `parts`.
fn refuse(mut command: Command, parts: &[&str]) {
    let output = command.output().unwrap();
    assert!(!output.status.success(), "should have failed: {parts:?}");
    let text = stderr(&output);
    let errors: Vec<&str> = text.lines().filter(|line| line.starts_with("cosurf-agent: ")).collect();
    assert_eq!(errors.len(), 1, "one line: {text}");
    assert!(!text.contains("panicked"), "{text}");
    for part in parts {
        assert!(errors[0].contains(part), "{part:?} is not in {:?}", errors[0]);
    }
}

fn model(out: &Path) -> Vec<u8> {
    fs::read(out.join("model.ply")).unwrap()
}

#[test]
fn bytes_depend_on_the_seed_and_not_on_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let out = |name: &str| folder.path().join(name);
    for threads in ["1", "2", "8"] {
        succeed(train(city(), &out(threads), &["--steps", "120", "--threads", threads]));
    }
    succeed(train(city(), &out("seed"), &["--steps", "120", "--seed", "1"]));
    assert!(model(&out("1")) == model(&out("2")), "2 threads");
    assert!(model(&out("1")) == model(&out("8")), "8 threads");
    assert!(model(&out("1")) != model(&out("seed")), "another seed");
}

#[test]
fn a_closed_pipe_ends_a_command_without_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = train(city(), folder.path(), &["--steps", "1"]);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(!stderr(&output).contains("panicked") && !model(folder.path()).is_empty(), "{}", stderr(&output));
}

#[test]
fn a_training_initialised_with_a_model_is_ahead() {
    let folder = tempfile::tempdir().unwrap();
    let [first, warm, cold] = ["first", "warm", "cold"].map(|name| folder.path().join(name));
    succeed(train(city(), &first, &["--steps", "400"]));
    succeed(train(city(), &warm, &["--steps", "40", "--init", first.join("model.ply").to_str().unwrap()]));
    succeed(train(city(), &cold, &["--steps", "40"]));
    let psnr = |out: &Path| report(out)["psnr"].as_f64().unwrap();
    let (warm, cold) = (psnr(&warm), psnr(&cold));
    assert!(warm > cold + 1.0, "{warm:.2} dB from a model, {cold:.2} dB from points");
    refuse(train(city(), &folder.path().join("none"), &["--init", "none.ply"]), &["none.ply"]);
}

#[test]
fn a_model_stands_in_for_missing_sparse_points() {
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = ["first", "second"].map(|name| folder.path().join(name));
    succeed(train(city(), &first, &["--steps", "100"]));
    let data = copy_of_city();
    fs::remove_file(data.path().join("sparse/0/points3D.bin")).unwrap();
    let output = train(data.path(), &folder.path().join("random"), &["--steps", "20"]).output().unwrap();
    assert!(output.status.success() && stderr(&output).contains("random"), "{}", stderr(&output));
    let model = first.join("model.ply");
    succeed(train(data.path(), &second, &["--steps", "20", "--init", model.to_str().unwrap()]));
    let psnr = |out: &Path| report(out)["psnr"].as_f64().unwrap();
    let (first, second) = (psnr(&first), psnr(&second));
    assert!(second > first - 1.0, "{second:.2} dB from a model of {first:.2} dB");
}

#[test]
fn a_killed_training_resumes_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, broken) = (folder.path().join("whole"), folder.path().join("broken"));
    let words = ["--steps", "400"];
    succeed(train(city(), &whole, &words));
    let state = broken.join("checkpoint/state.bin");
    let mut child =
        train(city(), &broken, &words).stderr(Stdio::null()).stdout(Stdio::null()).spawn().unwrap();
    let started = Instant::now();
    while !state.exists() {
        assert!(started.elapsed() < Duration::from_secs(120), "no checkpoint");
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!broken.join("model.ply").exists(), "the training ended before it was killed");
    let output = train(city(), &broken, &words).output().unwrap();
    assert!(stderr(&output).contains("resumed at step"), "{}", stderr(&output));
    assert!(model(&whole) == model(&broken));
}

#[test]
fn a_training_that_is_asked_to_end_writes_a_checkpoint_and_says_how_to_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let (out, log) = (folder.path().join("out"), folder.path().join("log"));
    let words = ["--steps", "2000", "--max-size", "48"];
    for (signal, resumed) in [("-INT", false), ("-TERM", true)] {
        let mut command = train(city(), &out, &words);
        let mut child =
            command.stderr(fs::File::create(&log).unwrap()).stdout(Stdio::null()).spawn().unwrap();
        let (text, started) = (|| fs::read_to_string(&log).unwrap(), Instant::now());
        while !text().contains("training views") {
            assert!(started.elapsed() < Duration::from_secs(120), "{}", text());
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(text().contains("resumed at step"), resumed, "{}", text());
        let killed = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
        assert!(killed.success());
        // The code after a signal, which the systemd unit does not count as a failure.
        assert_eq!(child.wait().unwrap().code(), Some(130));
        assert!(
            text().contains("stopped at step") && text().contains("run the same command again"),
            "{}",
            text()
        );
        assert!(out.join("checkpoint/state.bin").exists());
    }
}

/// Runs a short training with the options `words`, and returns what it writes to standard error.
fn log_of_training(words: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let mut command = train(city(), folder.path(), &["--steps", "2", "--compute", "cpu"]);
    let output = command.args(words).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    stderr(&output)
}

/// The passes of one training step, as the log names them.
const PASSES: [&str; 7] =
    ["project", "bin", "rasterize", "losses", "rasterize_backward", "project_backward", "adam"];

#[test]
fn a_log_names_stages_and_passes_with_their_times() {
    let text = log_of_training(&["--log", "trace"]);
    for pass in PASSES {
        // Counts only passes directly within a step. Surveys, which score splats over all views, run some of the passes
        // too.
        let path = format!(":{pass}: cosurf_engine::any: close time.busy=");
        let in_step = |line: &str| {
            let rest = line.split_once("train{steps=2}:step{").and_then(|(_, rest)| rest.split_once('}'));
            rest.is_some_and(|(_, rest)| rest.starts_with(&path))
        };
        assert_eq!(text.lines().filter(|line| in_step(line)).count(), 2, "{pass}: {text}");
    }
    let stages = log_of_training(&["--log", "info"]);
    assert!(stages.contains("train{steps=2}: ") && stages.contains("evaluate{"), "{stages}");
    assert!(!stages.contains("step{") && !stages.contains("adam"), "{stages}");
}

#[test]
fn a_log_in_json_has_one_object_per_line() {
    let text = log_of_training(&["--json", "--log", "cosurf_engine=trace", "--log-format", "json"]);
    let lines: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    for pass in PASSES {
        let in_step = |line: &&serde_json::Value| {
            let parent = line["spans"].as_array().and_then(|spans| spans.last());
            line["span"]["name"] == pass && parent.is_some_and(|parent| parent["name"] == "step")
        };
        let closed = lines.iter().filter(in_step).filter(|line| line["fields"]["time.busy"].is_string());
        assert_eq!(closed.count(), 2, "{pass}: {text}");
    }
    assert!(lines.iter().all(|line| line["target"].as_str().unwrap().starts_with("cosurf_engine")), "{text}");
}

#[test]
fn without_the_option_there_is_no_log() {
    let text = log_of_training(&["--log-format", "json"]);
    assert!(!text.contains("time.busy") && !text.contains("cosurf_engine"), "{text}");
}

#[test]
fn a_wrong_log_filter_gets_one_clear_line() {
    for filter in ["loud", "cosurf_engine=loud", "info,,debug"] {
        let mut command = agent(&["--log", filter]);
        command.args(["eval", "none.ply", "nowhere"]);
        refuse(command, &["--log", filter, "info,cosurf_engine=trace"]);
    }
}

/// Whether there is a GPU; a software driver counts as one. If there is none, reports the test as skipped.
fn has_gpu() -> bool {
    let devices = agent(&["devices", "--json"]).output().unwrap();
    let found = String::from_utf8_lossy(&devices.stdout).contains("gpu:0");
    if !found {
        skip("REQUIRE_GPU", "there is no GPU");
    }
    found
}

/// Trains, and returns the mean PSNR of the held-out views, dB.
fn train_and_score(data: &Path, out: &Path, words: &[&str]) -> f64 {
    succeed(train(data, out, words));
    report(out)["psnr"].as_f64().unwrap()
}

fn report(out: &Path) -> serde_json::Value {
    serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap()
}

#[test]
fn a_gpu_trains_the_same_model_and_the_cpu_reads_its_checkpoint() {
    if !has_gpu() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let out = |name: &str| folder.path().join(name);
    let on = |device, name: &str| {
        let words = ["--steps", "120", "--compute", device, "--memory", "600MiB"];
        let psnr = train_and_score(city(), &out(name), &words);
        let report = report(&out(name));
        assert!(report["peak_memory_bytes"].as_u64().unwrap() < 600 << 20, "{report}");
        psnr
    };
    let (cpu, gpu) = (on("cpu", "cpu"), on("gpu", "gpu"));
    assert!((cpu - gpu).abs() < 0.1, "{cpu} dB on the CPU, {gpu} dB on the GPU");
    on("gpu", "again");
    assert!(model(&out("gpu")) == model(&out("again")), "two runs on the GPU");
    // The checkpoint has all steps, so the CPU does not train: it only writes the model again from the GPU's
    // checkpoint.
    fs::remove_file(out("gpu").join("model.ply")).unwrap();
    on("cpu", "gpu");
    assert!(model(&out("gpu")) == model(&out("again")), "the CPU reads the GPU's checkpoint");
    refuse(train(city(), &out("none"), &["--compute", "gpu:99"]), &["there is no GPU 99"]);
}

/// Hides all Vulkan drivers from a command, so that it finds no GPU on Linux.
fn without_drivers(mut command: Command) -> Command {
    let nowhere = std::env::temp_dir().join("no-driver-is-here.json");
    command.env("VK_DRIVER_FILES", &nowhere).env("VK_ICD_FILENAMES", &nowhere);
    command
}

#[cfg(target_os = "linux")]
#[test]
fn without_a_gpu_the_cpu_trains_and_the_output_says_so() {
    let output = without_drivers(agent(&["devices"])).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("no GPU") && text.contains("--compute cpu"), "{text}");
    let folder = tempfile::tempdir().unwrap();
    let out = |name: &str| folder.path().join(name);
    let words = |device| ["--steps", "60", "--memory", "1GiB", "--compute", device];
    let output = without_drivers(train(city(), &out("auto"), &words("auto"))).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("steps/s, cpu "), "the output names the device: {text}");
    succeed(train(city(), &out("cpu"), &words("cpu")));
    assert!(model(&out("auto")) == model(&out("cpu")), "the same bytes");
    refuse(without_drivers(train(city(), &out("gpu"), &words("gpu"))), &["no GPU", "--compute cpu"]);
}

#[test]
fn more_steps_go_on_from_the_end_of_a_training() {
    let folder = tempfile::tempdir().unwrap();
    let [out, whole] = ["out", "whole"].map(|name| folder.path().join(name));
    succeed(train(city(), &out, &["--steps", "40"]));
    let output = train(city(), &out, &["--steps", "60"]).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains("resumed at step 40"), "{}", stderr(&output));
    succeed(train(city(), &whole, &["--steps", "60"]));
    let psnr = |out: &Path| report(out)["psnr"].as_f64().unwrap();
    assert_eq!(report(&out)["steps"], 60);
    assert!((psnr(&out) - psnr(&whole)).abs() < 1.0, "{} and {}", psnr(&out), psnr(&whole));
    assert!(model(&out) != model(&whole), "its first steps were those of a shorter training");
}

#[test]
fn a_damaged_checkpoint_is_set_aside_and_one_of_another_training_refused() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    succeed(train(city(), &out, &["--steps", "20"]));
    refuse(train(city(), &out, &["--steps", "20", "--seed", "7"]), &["other data or settings", "--fresh"]);
    refuse(train(city(), &out, &["--steps", "19"]), &["training of 20 steps", "fewer", "delete it"]);
    let state = out.join("checkpoint/state.bin");
    let mut bytes = fs::read(&state).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    fs::write(&state, &bytes).unwrap();
    let undamaged = model(&out);
    for (damaged, name) in [
        (&bytes[..], "state.damaged"),
        (&bytes[..bytes.len() / 3], "state.damaged-2"),
        (b"hello", "state.damaged-3"),
        (b"", "state.damaged-4"),
    ] {
        fs::write(&state, damaged).unwrap();
        let output = train(city(), &out, &["--steps", "20"]).output().unwrap();
        let told = stderr(&output);
        assert!(output.status.success() && told.contains(name), "{told}");
        assert!(told.contains("state.bin") && told.contains("training starts again"), "{told}");
        assert!(model(&out) == undamaged, "{name}: other bytes");
    }
}

#[test]
fn the_memory_limit_is_kept_and_its_cost_reported() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    succeed(train(city(), &out, &["--steps", "60", "--memory", "40MiB", "--threads", "2"]));
    let report: serde_json::Value =
        serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
    let peak = report["peak_memory_bytes"].as_u64().unwrap();
    assert!(peak < 40 << 20, "{peak} bytes");
    for field in ["steps", "seconds", "steps_per_s", "splats", "psnr", "ssim", "seed", "device"] {
        assert!(!report[field].is_null(), "{field}");
    }
    refuse(
        train(city(), &out, &["--steps", "5", "--fresh", "--memory", "20MiB"]),
        &["20.0 MiB", "needs at least"],
    );
}

/// A model of this many splats on a ground of 35 × 35.
fn ground(count: u32) -> Splats {
    let across = f64::from(count).sqrt() as u32;
    let mut model = Splats::with_capacity(count as usize, 3);
    for i in 0..count {
        let at = [i % across, i / across].map(|k| 35.0 * (k as f32 / across as f32 - 0.5));
        model.push([at[0], at[1], 0.0], [1.0, 0.0, 0.0, 0.0], [-3.0; 3], 1.0, &[0.1; 48]);
    }
    model
}

#[test]
fn many_points_and_a_large_model_to_start_from_keep_the_memory_limit() {
    let data = copy_of_city();
    let (limit, words) = (64 << 20, ["--steps", "2", "--memory", "64MiB", "--threads", "2"]);
    let report_of = |out: &Path| -> serde_json::Value {
        serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap()
    };
    let keeps = |report: &serde_json::Value| {
        let peak = report["peak_memory_bytes"].as_u64().unwrap();
        assert!(peak < limit, "{peak} bytes");
    };
    let init = data.path().join("init.ply");
    ply::write(&init, &ground(500_000), &LocalFrame::WORLD).unwrap();
    let from_model = data.path().join("from_model");
    succeed(train(data.path(), &from_model, &[&words[..], &["--init", init.to_str().unwrap()]].concat()));
    let report = report_of(&from_model);
    keeps(&report);
    assert!(report["given_up"].to_string().contains("splats to start from"), "{}", report["given_up"]);

    let mut dataset = Dataset::open(data.path()).unwrap();
    dataset.points = dataset.points.iter().cloned().cycle().take(600_000).collect();
    colmap::write(data.path(), &dataset).unwrap();
    let from_points = data.path().join("from_points");
    succeed(train(data.path(), &from_points, &words));
    let report = report_of(&from_points);
    keeps(&report);
    let given_up = report["given_up"].to_string();
    assert!(given_up.contains("of the sparse points, one of"), "{given_up}");
}

#[test]
fn a_finished_model_is_shown_and_scored_within_the_memory_that_a_refusal_asks_for() {
    let folder = tempfile::tempdir().unwrap();
    let (model, pictures) = (folder.path().join("model.ply"), folder.path().join("pictures"));
    ply::write(&model, &ground(150_000), &LocalFrame::WORLD).unwrap();
    let (model, city) = (model.to_str().unwrap(), city().to_str().unwrap());
    let render = ["render", model, "--cameras", city, "--out", pictures.to_str().unwrap()];
    for words in [&render[..], &["eval", model, city]] {
        let run = |limit: &str| {
            let mut command = agent(&[words, &["--memory", limit, "--threads", "2"]].concat());
            command.stdout(Stdio::null());
            command
        };
        let refused = stderr(&run("30MiB").output().unwrap());
        let (_, asked) = refused.split_once("--memory ").expect("it says how much it needs");
        let asked = asked.split_whitespace().next().unwrap();
        let usage = watch(&mut run(asked).stderr(Stdio::null()).spawn().unwrap());
        let asked_bytes = parse_bytes(asked).unwrap();
        assert!(usage.succeeded && usage.peak_bytes <= asked_bytes, "{asked}: {usage:?}");
        // What it asks for is not much more than it takes.
        assert!(2 * usage.peak_bytes > asked_bytes, "{asked}: {usage:?}");
        let on_gpu = agent(&[words, &["--memory", "1GiB", "--compute", "gpu"]].concat());
        refuse(on_gpu, &["kept on the CPU only", "--compute cpu"]);
    }
}

#[test]
fn bad_datasets_get_one_clear_line() {
    let out = tempfile::tempdir().unwrap();
    let damaged = |damage: &dyn Fn(&Path), parts: &[&str]| {
        let data = copy_of_city();
        damage(data.path());
        refuse(train(data.path(), &out.path().join("o"), &["--steps", "3"]), parts);
    };
    let picture = |data: &Path| -> PathBuf {
        let mut names: Vec<_> =
            fs::read_dir(data.join("images")).unwrap().map(|e| e.unwrap().path()).collect();
        names.sort();
        names.swap_remove(3)
    };
    damaged(&|data| fs::remove_file(picture(data)).unwrap(), &["missing"]);
    let all = |data: &Path| fs::read_dir(data.join("images")).unwrap().map(|e| e.unwrap().path());
    damaged(&|data| all(data).for_each(|path| fs::write(path, b"").unwrap()), &["empty"]);
    damaged(&|data| all(data).for_each(|path| fs::write(path, b"not a picture").unwrap()), &[".jpg"]);
    damaged(
        &|data| {
            let path = data.join("sparse/0/points3D.bin");
            let bytes = fs::read(&path).unwrap();
            fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        },
        &["points3D.bin"],
    );
    damaged(
        &|data| {
            let path = data.join("sparse/0/cameras.bin");
            let mut bytes = fs::read(&path).unwrap();
            bytes[12..16].copy_from_slice(&4i32.to_le_bytes());
            bytes.extend([1; 32]); // the four numbers of its distortion
            fs::write(&path, bytes).unwrap();
        },
        &["OPENCV", "colmap image_undistorter"],
    );
    refuse(train(&out.path().join("nothing"), out.path(), &["--steps", "3"]), &["nothing"]);
}

/// A card that was pulled out damages a picture. The others are enough.
#[test]
fn single_damaged_pictures_are_left_out_and_told() {
    let data = copy_of_city();
    let mut pictures: Vec<_> =
        fs::read_dir(data.path().join("images")).unwrap().map(|e| e.unwrap().path()).collect();
    pictures.sort();
    let whole = fs::read(&pictures[2]).unwrap();
    for (picture, content) in [(1, &b""[..]), (2, &whole[..whole.len() / 2]), (3, b"not a picture")] {
        fs::write(&pictures[picture], content).unwrap();
    }
    let out = tempfile::tempdir().unwrap();
    let output = train(data.path(), &out.path().join("o"), &["--steps", "3"]).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}");
    for picture in &pictures[1..4] {
        let name = picture.file_name().unwrap().to_str().unwrap();
        assert!(told.lines().any(|line| line.starts_with("left out: ") && line.contains(name)), "{told}");
    }
    assert_eq!(told.lines().filter(|line| line.starts_with("left out: ")).count(), 3, "{told}");
}

#[test]
fn bad_models_get_one_clear_line() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    succeed(train(city(), &out, &["--steps", "5"]));
    let whole = model(&out);
    let header = 11 + whole.windows(10).position(|bytes| bytes == b"end_header").unwrap();
    let eval = |bytes: &[u8], parts: &[&str]| {
        let path = folder.path().join("bad.ply");
        fs::write(&path, bytes).unwrap();
        let mut command = agent(&["eval"]);
        command.arg(&path).arg(city());
        refuse(command, parts);
    };
    let mut nan = whole.clone();
    nan[header..header + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    let path = folder.path().join("one_bad.ply");
    fs::write(&path, &nan).unwrap();
    let output = agent(&["eval"]).arg(&path).arg(city()).output().unwrap();
    let told = stderr(&output);
    assert!(output.status.success() && told.contains("one_bad.ply: 1 splat is infinite"), "{told}");
    eval(&whole[..whole.len() - 10], &["bad.ply"]);
    let claim = String::from_utf8_lossy(&whole[..header]).into_owned();
    let count = claim.lines().find_map(|line| line.strip_prefix("element vertex ")).unwrap().to_owned();
    eval(claim.replace(&count, "1000000000000").as_bytes(), &["bad.ply", "1000000000000"]);
}

#[test]
fn rendering_writes_pictures_and_depths() {
    let folder = tempfile::tempdir().unwrap();
    let (out, pictures) = (folder.path().join("out"), folder.path().join("pictures"));
    succeed(train(city(), &out, &["--steps", "5"]));
    let mut command = agent(&["render"]);
    command.arg(&out).arg("--cameras").arg(city()).arg("--out").arg(&pictures).args(["--max-size", "48"]);
    succeed(command);
    for kind in ["color.png", "depth.png", "normal.png"] {
        assert_eq!(cosurf_scene::Picture::size_of(&pictures.join(format!("0000.{kind}"))).unwrap(), [48, 36]);
    }
    let depths = fs::read(pictures.join("0000.depth.pfm")).unwrap();
    assert_eq!(depths.len(), "Pf\n48 36\n-1.0\n".len() + 48 * 36 * 4);
}

#[test]
fn a_wrong_configuration_gets_one_clear_line() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("agent.toml");
    let right = "device = \"d\"\nsite = \"s\"\nbroker = \"h\"\ndata = \"in\"\nout = \"out\"\nsteps = 7\n";
    for (text, part) in [
        (right.replace("\"d\"", "\"a b\""), "line 1, device: "),
        (right.replace("\"h\"", "\"h:port\""), "line 3, broker: "),
        (format!("{right}compute = \"cuda\"\n"), "line 7, compute: "),
        (format!("{right}serial = \"/dev/ttyUSB0\"\n"), "either broker"),
    ] {
        fs::write(&config, text).unwrap();
        let mut command = agent(&["run"]);
        command.arg("--config").arg(&config);
        refuse(command, &["agent.toml", part]);
    }
}
