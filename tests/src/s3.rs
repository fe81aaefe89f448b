//! Runs an S3 server as a child process: the example `s3` of this package.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::programs::program;

/// The one bucket of the server.
const BUCKET: &str = "site";
const KEY: &str = "key-of-tests";
const SECRET: &str = "secret-of-tests";

/// A running S3 server. It is killed when this value is dropped.
pub struct S3 {
    port: u16,
    child: Child,
}

impl S3 {
    /// Starts a server that keeps its objects in `folder`. Every `fail_every`-th request fails; 0 for none.
    pub fn start(folder: &Path, fail_every: u64) -> Self {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        fs::create_dir_all(folder.join(BUCKET)).unwrap();
        let mut command = Command::new(program("examples/s3"));
        command.arg(folder).args([&port.to_string(), KEY, SECRET, &fail_every.to_string()]);
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().unwrap();
        let server = Self { port, child };
        let begun = Instant::now();
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(begun.elapsed() < Duration::from_secs(20), "the S3 server does not listen");
            std::thread::sleep(Duration::from_millis(10));
        }
        server
    }

    /// The address of objects whose names begin with `prefix`.
    pub fn url(&self, prefix: &str) -> String {
        format!("s3://{BUCKET}/{prefix}")
    }

    /// What a program needs in its environment to use the server.
    pub fn environment(&self) -> [(&'static str, String); 4] {
        [
            ("AWS_ACCESS_KEY_ID", KEY.to_owned()),
            ("AWS_SECRET_ACCESS_KEY", SECRET.to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
            ("AWS_ENDPOINT_URL", format!("http://127.0.0.1:{}", self.port)),
        ]
    }
}

impl Drop for S3 {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
