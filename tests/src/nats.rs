//! Runs a NATS server with JetStream as a child process.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::skips::skip;

/// A running NATS server. It is killed when this value is dropped.
pub struct Nats {
    port: u16,
    folder: PathBuf,
    child: Child,
}

impl Nats {
    /// Starts a server that keeps its queues in `folder`. If NATS is not installed, reports that the test is skipped and
    /// returns `None`; panics instead if the environment variable `REQUIRE_NATS` is set.
    pub fn start(folder: &Path) -> Option<Self> {
        Self::start_with(folder, "")
    }

    /// As [`Self::start`], with the lines of a configuration file.
    pub fn start_with(folder: &Path, config: &str) -> Option<Self> {
        fs::create_dir_all(folder).unwrap();
        fs::write(config_of(folder), config).unwrap();
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let Some(child) = spawn(port, folder) else {
            skip("REQUIRE_NATS", "nats-server is not installed");
            return None;
        };
        let server = Self { port, folder: folder.to_owned(), child };
        server.await_port();
        Some(server)
    }

    /// The address of the server.
    pub fn url(&self) -> String {
        format!("nats://127.0.0.1:{}", self.port)
    }

    /// Kills the server.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Starts the server again on the same port and folder.
    pub fn start_again(&mut self) {
        self.child = spawn(self.port, &self.folder).unwrap();
        self.await_port();
    }

    fn await_port(&self) {
        let begun = Instant::now();
        while TcpStream::connect(("127.0.0.1", self.port)).is_err() {
            assert!(begun.elapsed() < Duration::from_secs(20), "nats-server does not listen");
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Nats {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn config_of(folder: &Path) -> PathBuf {
    folder.join("nats.conf")
}

fn spawn(port: u16, folder: &Path) -> Option<Child> {
    ["nats-server", "/usr/sbin/nats-server"].iter().find_map(|program| {
        let mut command = Command::new(program);
        let port = port.to_string();
        command.args(["-a", "127.0.0.1", "-p", port.as_str(), "-js", "-sd"]).arg(folder);
        command.arg("-c").arg(config_of(folder));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().ok()
    })
}
