//! Runs a WebSocket listener in front of a broker as a child process.

use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cosurf_link::BrokerAddress;

use crate::skips::skip;

/// The listener, a program in Python: another implementation of WebSocket and TLS than the one under test.
const PROGRAM: &str = include_str!("web_door.py");

/// A running listener. It is killed when this value is dropped.
pub struct WebDoor {
    /// The address at which it listens.
    pub address: BrokerAddress,
    child: Child,
}

impl WebDoor {
    /// Starts a listener in front of `broker`, with TLS if there are a certificate and its key. If Python has no package
    /// `websockets`, reports that the test is skipped and returns `None`; panics instead if the environment variable
    /// `REQUIRE_VALIDATORS` is set.
    pub fn start(broker: &BrokerAddress, tls: Option<(&Path, &Path)>) -> Option<Self> {
        let Some(python) = python() else {
            skip("REQUIRE_VALIDATORS", "Python has no package websockets");
            return None;
        };
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let mut command = Command::new(python);
        command.args(["-c", PROGRAM, &port.to_string(), &broker.port.to_string()]);
        if let Some((cert, key)) = tls {
            command.arg(cert).arg(key);
        }
        let child = command.stdin(Stdio::null()).spawn().unwrap();
        let address = BrokerAddress {
            is_tls: tls.is_some(),
            web_path: Some("/mqtt".to_owned()),
            ..BrokerAddress::plain("127.0.0.1", port)
        };
        let door = Self { address, child };
        let begun = Instant::now();
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(begun.elapsed() < Duration::from_secs(20), "the WebSocket listener does not start");
            std::thread::sleep(Duration::from_millis(20));
        }
        Some(door)
    }
}

impl Drop for WebDoor {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A Python with the package. `.ci/run` installs it beside the validators, whose programs are on the path.
fn python() -> Option<String> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/validators/bin/python");
    [beside.display().to_string(), "python3".to_owned()].into_iter().find(|python| {
        let mut command = Command::new(python);
        command.args(["-c", "import websockets.asyncio.server"]).stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok_and(|status| status.success())
    })
}
