//! Kills broker, agents and aggregator at random moments (`kill -9`), and checks that every mission still ends with
//! the same global model, byte for byte.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_link::faults::Dice;
use cosurf_tests::datasets::write_city;
use cosurf_tests::mosquitto::{Mosquitto, PLAIN};
use cosurf_tests::programs::program;

const AGENTS: [&str; 2] = ["agent-1", "agent-2"];
const KILLS: usize = 4;
const PATIENCE: Duration = Duration::from_secs(300);

/// A running program, which can be killed and started again. It is killed when this value is dropped.
struct Part {
    name: &'static str,
    config: PathBuf,
    child: Child,
}

impl Part {
    fn start(program_name: &'static str, config: PathBuf) -> Self {
        let child = Self::spawn(program_name, &config);
        Self { name: program_name, config, child }
    }

    fn spawn(name: &str, config: &Path) -> Child {
        let log = fs::File::options().create(true).append(true).open(config.with_extension("log")).unwrap();
        let mut command = Command::new(program(name));
        command.args(["run", "--config"]).arg(config).stdin(Stdio::null()).stdout(Stdio::null());
        command.stderr(log).spawn().unwrap()
    }

    fn is_over(&mut self) -> bool {
        match self.child.try_wait().unwrap() {
            Some(status) => {
                let log = fs::read_to_string(self.config.with_extension("log")).unwrap_or_default();
                assert!(status.success(), "{}: {status}: {log}", self.config.display());
                true
            }
            None => false,
        }
    }

    /// Kills the program and starts it again. If the program has already ended, only returns false.
    fn kill_and_restart(&mut self) -> bool {
        if self.is_over() {
            return false;
        }
        self.kill();
        self.child = Self::spawn(self.name, &self.config);
        true
    }

    fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        self.kill();
    }
}

/// The result of a mission.
struct Flight {
    /// `global.ply` of the aggregator and of each agent.
    globals: [Vec<u8>; 3],
    time: Duration,
}

/// Runs one mission, and kills a random program at each of the moments `kill_at`, which are times since the start.
/// `None` if Mosquitto is not installed.
fn fly(folder: &Path, data: &Path, dice: &mut Dice, mut kill_at: Vec<Duration>) -> Option<Flight> {
    fs::create_dir_all(folder).unwrap();
    let mut broker = Mosquitto::start(folder, PLAIN, false)?;
    let url = format!("mqtt://{}", broker.address);
    let at = |name: &str| folder.join(name);
    let out = |name: &str| at(name).display().to_string();
    fs::write(
        at("ground.toml"),
        format!("site = \"s\"\nout = \"{}\"\nbroker = \"{url}\"\nquorum = 2\nquiet_s = 0\n", out("ground")),
    )
    .unwrap();
    for (agent, name) in AGENTS.iter().enumerate() {
        let views: Vec<String> = (0..8)
            .filter(|view| view % 2 == agent)
            .map(|view| format!("\"{}\"", view_name(data, view)))
            .collect();
        let text = format!(
            "device = \"{name}\"\nsite = \"s\"\nbroker = \"{url}\"\ndata = \"{}\"\nout = \"{}\"\nsteps = 30\n\
             views = [{}]\nthreads = 1\nwait_global = true\n",
            data.display(),
            out(name),
            views.join(", ")
        );
        fs::write(at(&format!("{name}.toml")), text).unwrap();
    }
    let mut ground = Part::start("cosurf-aggregator", at("ground.toml"));
    let mut agents = AGENTS.map(|name| Part::start("cosurf-agent", at(&format!("{name}.toml"))));
    let begun = Instant::now();
    kill_at.sort();
    kill_at.reverse();
    while !agents.iter_mut().all(Part::is_over) || !kill_at.is_empty() {
        assert!(begun.elapsed() < PATIENCE, "{} does not end", folder.display());
        if kill_at.last().is_some_and(|at| begun.elapsed() >= *at) {
            kill_at.pop();
            while !match dice.below(4) {
                0 => {
                    broker.kill();
                    broker.start_again();
                    true
                }
                1 => ground.kill_and_restart(),
                agent => agents[agent as usize - 2].kill_and_restart(),
            } {}
        }
        sleep(Duration::from_millis(5));
    }
    let time = begun.elapsed();
    let globals = ["ground", AGENTS[0], AGENTS[1]].map(|name| fs::read(at(name).join("global.ply")).unwrap());
    Some(Flight { globals, time })
}

fn view_name(data: &Path, view: usize) -> String {
    let mut names: Vec<String> = fs::read_dir(data.join("images"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names[view].clone()
}

fn missions(count: u64) {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    write_city(&data, 60.0, 8, [96, 72]);
    let Some(calm) = fly(&folder.path().join("calm"), &data, &mut Dice::new(0), Vec::new()) else { return };
    // The aggregator writes its file before it packs the model, and the agents write theirs after unpacking. Packing
    // is lossy, so only the agents' files are equal to each other.
    assert!(calm.globals[1] == calm.globals[2], "the agents have different global models");
    for seed in 1..=count {
        let wild = folder.path().join(format!("wild-{seed}"));
        let mut dice = Dice::new(seed);
        let millis = calm.time.as_millis() as u64;
        let kill_at = (0..KILLS).map(|_| Duration::from_millis(dice.below(millis))).collect();
        let flight = fly(&wild, &data, &mut dice, kill_at).unwrap();
        assert!(flight.globals == calm.globals, "seed {seed}: another global model");
        println!("mission {seed}: {KILLS} kills, {:.1?} instead of {:.1?}", flight.time, calm.time);
        fs::remove_dir_all(wild).unwrap();
    }
}

#[test]
fn two_missions_with_kills() {
    missions(2);
}

/// Run it with `cargo test --release -p cosurf-tests --test kills -- --ignored --nocapture`.
#[test]
#[ignore = "takes minutes"]
fn fifty_missions_with_kills() {
    missions(50);
}
