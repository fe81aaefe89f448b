//! `cosurf-aggregator run` as a process of its own.

use std::fs;
use std::io::{BufRead, BufReader, Lines};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};

use cosurf_aggregator::broker::MEMORY_BYTES_MIN;
use cosurf_link::BrokerAddress;
use cosurf_tests::offers::broker_address;
use cosurf_tests::usage::peak_bytes;

use crate::raw::Raw;
use crate::station::loopback;

/// Bound of the broker's memory in these tests, bytes.
pub(crate) const BOUND: u64 = MEMORY_BYTES_MIN as u64;

/// `cosurf-aggregator run` with a broker whose memory is [`BOUND`]; killed when dropped.
pub(crate) struct Ground {
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
    pub(crate) address: SocketAddr,
    is_tls: bool,
    /// Peak resident memory before the attack, bytes.
    before: u64,
}

impl Ground {
    pub(crate) fn start(folder: &Path) -> Self {
        let mut ground = Self::start_with(folder, &format!("broker_memory_bytes = {BOUND}\n"), false);
        // A first client, so that what the first one takes is not counted.
        Raw::connect(ground.address, "first").publish("warm", &[0; 1000], false);
        ground.before = peak_bytes(ground.child.id()).unwrap();
        ground
    }

    /// Starts with more lines in the configuration; `is_tls` only tells how the broker is reached.
    pub(crate) fn start_with(folder: &Path, settings: &str, is_tls: bool) -> Self {
        let address = TcpListener::bind(loopback()).unwrap().local_addr().unwrap();
        let (config, out) = (folder.join("aggregator.toml"), folder.join("out"));
        let text = format!("site = \"site\"\nout = \"{}\"\nbind = \"{address}\"\n{settings}", out.display());
        fs::write(&config, text).unwrap();
        let mut ground = Self::spawn(folder, address);
        ground.is_tls = is_tls;
        ground.lines_until("connected to the broker");
        ground
    }

    /// Starts with the configuration that is in the folder, and waits for nothing.
    pub(crate) fn spawn(folder: &Path, address: SocketAddr) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
        command.args(["run", "--config"]).arg(folder.join("aggregator.toml"));
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines, address, is_tls: false, before: 0 }
    }

    /// Kills the program, as `kill -9` does.
    pub(crate) fn kill(mut self) {
        self.child.kill().unwrap();
    }

    /// The broker's address for clients of the link.
    pub(crate) fn broker(&self) -> BrokerAddress {
        BrokerAddress { is_tls: self.is_tls, ..broker_address(self.address) }
    }

    /// The lines that the program prints, up to the first one that contains `text`.
    pub(crate) fn lines_until(&mut self, text: &str) -> Vec<String> {
        let mut lines = Vec::new();
        while lines.last().is_none_or(|line: &String| !line.contains(text)) {
            lines.push(self.lines.next().expect("the program has ended").unwrap());
        }
        lines
    }

    /// Bytes that the attack has taken at its peak.
    pub(crate) fn taken(&self) -> u64 {
        peak_bytes(self.child.id()).unwrap() - self.before
    }

    /// Number of entries in a folder of `/proc` of the process.
    pub(crate) fn count(&self, folder: &str) -> usize {
        fs::read_dir(format!("/proc/{}/{folder}", self.child.id())).unwrap().count()
    }
}

impl Drop for Ground {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
