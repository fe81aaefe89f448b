//! Programs of the workspace that run beside a test.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::programs::program;

/// Time after which a test gives a program up.
pub const PATIENCE: Duration = Duration::from_secs(240);

/// A running program with its log. It is killed when this value is dropped.
#[derive(Debug)]
pub struct Running {
    child: Child,
    log: PathBuf,
}

impl Running {
    /// Starts a program of the workspace in `folder`, with its output in `NAME.log` there.
    pub fn start(name: &str, folder: &Path, arguments: &[&str]) -> Self {
        let log = folder.join(format!("{name}.log"));
        let [out, err] = [(); 2].map(|()| fs::File::options().create(true).append(true).open(&log).unwrap());
        let mut command = Command::new(program(name));
        command.args(arguments).current_dir(folder).stdin(Stdio::null()).stdout(out).stderr(err);
        Self { child: command.spawn().unwrap(), log }
    }

    /// What it has printed so far.
    pub fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap()
    }

    /// The first address of a page in the log. Waits for it.
    pub fn page(&self) -> String {
        let begun = Instant::now();
        loop {
            if let Some(url) = self.log().lines().find(|line| line.starts_with("http://")) {
                return url.to_owned();
            }
            assert!(begun.elapsed() < PATIENCE, "no address: {}", self.log());
            sleep(Duration::from_millis(20));
        }
    }

    /// The number of its process.
    pub fn process(&self) -> u32 {
        self.child.id()
    }

    /// Path of the log.
    pub fn log_path(&self) -> &Path {
        &self.log
    }

    /// Waits for the end of the program. Returns whether it ended well, and its log.
    pub fn end(mut self) -> (bool, String) {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return (status.success(), self.log());
            }
            assert!(begun.elapsed() < PATIENCE, "{} does not end: {}", self.log.display(), self.log());
            sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
