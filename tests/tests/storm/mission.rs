//! Honest missions: two drones train, upload, and receive the global model.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_tests::programs::program;

use crate::field::{SITE, drones};
use crate::ground::{Ground, on_cores, wait_for};

/// A mission that takes longer has failed.
const PATIENCE: Duration = Duration::from_secs(120);

/// What all drones have in common.
pub(crate) struct Fleet<'a> {
    /// Pictures with poses.
    pub(crate) data: &'a Path,
    pub(crate) keys: &'a Path,
    pub(crate) steps: u32,
    pub(crate) cores: Option<&'static str>,
}

/// The result of a mission.
pub(crate) struct Flight {
    /// The global model of the aggregator and of each drone.
    pub(crate) globals: [Vec<u8>; 3],
    /// From the start of the drones until all have the global model.
    pub(crate) time: Duration,
    /// What the drones have printed, with times.
    pub(crate) log: String,
}

/// A drone's program; killed when dropped.
struct Drone {
    child: Child,
    out: PathBuf,
}

impl Drop for Drone {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drone {
    fn log(&self) -> String {
        fs::read_to_string(self.out.with_extension("log")).unwrap_or_default()
    }

    fn is_over(&mut self) -> bool {
        let Some(status) = self.child.try_wait().unwrap() else { return false };
        assert!(status.success(), "{}: {status}: {}", self.out.display(), self.log());
        true
    }
}

impl Fleet<'_> {
    /// Flies mission `number`, whose drones have names of their own, so that each mission begins anew. In the end, the
    /// aggregator forgets them.
    pub(crate) fn fly(&self, ground: &Ground, number: usize) -> Flight {
        let names = drones(number);
        let folder = ground.folder.join(format!("../mission-{number}"));
        fs::create_dir_all(&folder).unwrap();
        let begun = Instant::now();
        let mut flying = [0, 1].map(|place| self.start(ground, &folder, &names[place], place));
        while !flying.iter_mut().all(Drone::is_over) {
            let logs = || flying.iter().map(Drone::log).collect::<String>();
            assert!(
                begun.elapsed() < PATIENCE,
                "mission {number} does not end\n{}\n{}",
                logs(),
                ground.printed()
            );
            sleep(Duration::from_millis(10));
        }
        wait_for("the merge of both drones", || ground.has_merged(&names));
        let time = begun.elapsed();
        let [first, second] = flying.each_ref().map(|drone| fs::read(drone.out.join("global.ply")).unwrap());
        let log = flying.iter().map(Drone::log).collect();
        let flight = Flight { globals: [ground.global(), first, second], time, log };
        ground.forget(&names);
        fs::remove_dir_all(folder).unwrap();
        flight
    }

    /// Starts a drone, which trains on every other picture.
    fn start(&self, ground: &Ground, folder: &Path, name: &str, place: usize) -> Drone {
        let (config, out, own) =
            (folder.join(format!("{name}.toml")), folder.join(name), self.keys.join(name));
        let views: Vec<String> = self.pictures().into_iter().skip(place).step_by(2).collect();
        let text = format!(
            "device = \"{name}\"\nsite = \"{SITE}\"\nbroker = \"mqtt://{}\"\ndata = \"{}\"\nout = \"{}\"\nsteps = {}\n\
             views = {views:?}\nthreads = 1\ncompute = \"cpu\"\nwait_global = true\nkey = \"{}\"\ntrusted = \"{}\"\n\
             fleet = \"{}\"\n",
            ground.address,
            self.data.display(),
            out.display(),
            self.steps,
            own.join("sign.key").display(),
            own.join("trusted.txt").display(),
            own.join("fleet.txt").display()
        );
        fs::write(&config, text).unwrap();
        let log = File::create(out.with_extension("log")).unwrap();
        let mut command = on_cores(program("cosurf-agent"), self.cores);
        command.args(["--log", "info", "run", "--config"]).arg(&config).stdin(Stdio::null());
        Drone { child: command.stderr(log.try_clone().unwrap()).stdout(log).spawn().unwrap(), out }
    }

    fn pictures(&self) -> Vec<String> {
        let files = fs::read_dir(self.data.join("images")).unwrap();
        let mut names: Vec<String> =
            files.map(|file| file.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}
