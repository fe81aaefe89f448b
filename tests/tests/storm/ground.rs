//! The aggregator under attack, as a process of its own.

use std::fs::{self, File};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_aggregator::service::Merging;
use cosurf_tests::programs::program;
use cosurf_tests::usage::peak_bytes;

use crate::field::{GROUND, SIGNERS, SITE, TRAITOR, drones};

const PATIENCE: Duration = Duration::from_secs(60);

/// Makes the keys of a site with all drones that may fly.
pub(crate) fn make_keys(keys: &Path, missions: usize) {
    let mut command = Command::new(program("cosurf-aggregator"));
    command.arg("pki").arg(keys).args(["--host", "127.0.0.1", "--aggregator", GROUND]);
    let names = (0..missions).flat_map(drones).chain([TRAITOR.to_owned()]).chain(SIGNERS.map(str::to_owned));
    names.for_each(|name| _ = command.args(["--device", &name]));
    assert!(command.stdout(Stdio::null()).status().unwrap().success());
}

/// A running aggregator with a built-in broker; killed when dropped.
pub(crate) struct Ground {
    child: Child,
    config: PathBuf,
    pub(crate) folder: PathBuf,
    pub(crate) address: SocketAddr,
    cores: Option<&'static str>,
    /// Bytes that the aggregator tells it takes at most.
    pub(crate) bound_bytes: u64,
}

impl Ground {
    /// Starts an aggregator in a new folder, on these cores, with 64 MiB for models.
    pub(crate) fn start(folder: &Path, keys: &Path, settings: &str, cores: Option<&'static str>) -> Self {
        fs::create_dir_all(folder).unwrap();
        let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let config = folder.join("aggregator.toml");
        let (out, own) = (folder.join("out"), keys.join(GROUND));
        let text = format!(
            "site = \"{SITE}\"\ndevice = \"{GROUND}\"\nout = \"{}\"\nbind = \"{address}\"\nkey = \"{}\"\n\
             trusted = \"{}\"\nmemory_bytes = {}\ncompute = \"cpu\"\nquorum = 3\nquiet_s = 1\n{settings}",
            out.display(),
            own.join("sign.key").display(),
            own.join("trusted.txt").display(),
            64 << 20
        );
        fs::write(&config, text).unwrap();
        let child = spawn(&config, cores);
        let mut ground = Self { child, config, folder: out, address, cores, bound_bytes: 0 };
        ground.await_line("connected to the broker");
        ground.bound_bytes = ground.told_bound();
        ground
    }

    /// Kills the aggregator (`kill -9`) and starts it again with the same folder.
    pub(crate) fn restart(&mut self) {
        self.kill();
        self.child = spawn(&self.config, self.cores);
        self.await_line("connected to the broker");
    }

    fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// What the aggregator has printed since it was started.
    pub(crate) fn printed(&self) -> String {
        String::from_utf8_lossy(&fs::read(self.config.with_extension("log")).unwrap()).into_owned()
    }

    fn await_line(&mut self, text: &str) {
        wait_for(text, || self.printed().contains(text));
    }

    fn told_bound(&self) -> u64 {
        let printed = self.printed();
        let line = printed.lines().find_map(|line| line.strip_prefix("memory: at most "));
        line.unwrap().split(' ').next().unwrap().parse::<u64>().unwrap() << 20
    }

    /// Peak resident memory, bytes. Fails if the aggregator has ended.
    pub(crate) fn peak_bytes(&mut self) -> u64 {
        assert_eq!(self.child.try_wait().unwrap(), None, "the aggregator has ended: {}", self.printed());
        peak_bytes(self.child.id()).unwrap()
    }

    /// Whether the newest global model was merged from models of these drones, and none of them was kept out.
    pub(crate) fn has_merged(&self, drones: &[String; 2]) -> bool {
        let Some(record) = Merging::read(&self.folder) else { return false };
        drones.iter().all(|drone| {
            record.inputs.iter().any(|input| input.device == *drone)
                && !record.kept_out.iter().any(|kept_out| kept_out.device == *drone)
        })
    }

    /// The bytes of the newest global model.
    pub(crate) fn global(&self) -> Vec<u8> {
        fs::read(self.folder.join("global.ply")).unwrap()
    }

    /// Forgets these drones and the traitor, and waits until nothing is left of their global model.
    pub(crate) fn forget(&self, drones: &[String; 2]) {
        for device in drones.iter().map(String::as_str).chain([TRAITOR]) {
            let mut command = Command::new(program("cosurf-aggregator"));
            command.args(["forget", device, "--announced", "--config"]).arg(&self.config);
            assert!(command.stdout(Stdio::null()).status().unwrap().success());
        }
        wait_for("the global model to be removed", || {
            !self.folder.join("global.ply").exists() && !self.folder.join("merged.json").exists()
        });
    }
}

impl Drop for Ground {
    fn drop(&mut self) {
        self.kill();
    }
}

fn spawn(config: &Path, cores: Option<&str>) -> Child {
    let log = File::create(config.with_extension("log")).unwrap();
    let mut command = on_cores(program("cosurf-aggregator"), cores);
    command.args(["--log", "info", "run", "--config"]).arg(config).stdin(Stdio::null());
    command.stderr(log.try_clone().unwrap()).stdout(log).spawn().unwrap()
}

/// Lets this process run on these cores only.
pub(crate) fn stay_on_cores(cores: &str) {
    let own = std::process::id().to_string();
    let status = Command::new("taskset").args(["-acp", cores, &own]).stdout(Stdio::null()).status();
    assert!(status.unwrap().success());
}

/// A command that runs on these cores only, in the notation of `taskset`.
pub(crate) fn on_cores(program: PathBuf, cores: Option<&str>) -> Command {
    match cores {
        None => Command::new(program),
        Some(cores) => {
            let mut command = Command::new("taskset");
            command.args(["-c", cores]).arg(program);
            command
        }
    }
}

pub(crate) fn wait_for(what: &str, mut is_done: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is_done() {
        assert!(begun.elapsed() < PATIENCE, "waited too long for: {what}");
        sleep(Duration::from_millis(10));
    }
}
