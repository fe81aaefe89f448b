//! Mosquitto as a child process, and certificates for it.
#![allow(clippy::unwrap_used, dead_code, missing_docs, unreachable_pub)]

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cosurf_link::{BrokerAddress, Tls, TlsFiles};

/// A running Mosquitto with a folder of its own; killed when dropped.
pub struct Mosquitto {
    pub address: BrokerAddress,
    config: PathBuf,
    child: Child,
}

impl Mosquitto {
    /// Starts one with the lines of `settings`, in which `PORT` and `FOLDER` stand for its own. `None`, with a
    /// word, where it is not installed; with `REQUIRE_MOSQUITTO=1` that fails.
    pub fn start(folder: &Path, settings: &str, is_tls: bool) -> Option<Self> {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let root = "user root\n";
        let text = settings.replace("PORT", &port.to_string()).replace("FOLDER", folder.to_str().unwrap());
        let config = folder.join("mosquitto.conf");
        fs::write(&config, format!("{root}{text}")).unwrap();
        let Some(child) = spawn(&config) else {
            assert!(std::env::var_os("REQUIRE_MOSQUITTO").is_none(), "mosquitto is not installed");
            println!("SKIPPED: mosquitto is not installed");
            return None;
        };
        let address = BrokerAddress { host: "127.0.0.1".to_owned(), port, is_tls };
        let broker = Self { address, config, child };
        broker.await_port();
        Some(broker)
    }

    /// Kills it without a chance to say or save anything.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Stops it in peace.
    pub fn terminate(&mut self) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").arg(id).status().unwrap().success());
        self.child.wait().unwrap();
    }

    pub fn start_again(&mut self) {
        self.child = spawn(&self.config).unwrap();
        self.await_port();
    }

    fn await_port(&self) {
        let begun = Instant::now();
        while TcpStream::connect(("127.0.0.1", self.address.port)).is_err() {
            assert!(begun.elapsed() < Duration::from_secs(20), "mosquitto does not listen");
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn spawn(config: &Path) -> Option<Child> {
    ["mosquitto", "/usr/sbin/mosquitto"].iter().find_map(|program| {
        let mut command = Command::new(program);
        command
            .arg("-c")
            .arg(config)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .ok()
    })
}

/// Certificates made by the `openssl` of this machine.
pub struct Authority(PathBuf);

impl Authority {
    /// Makes an authority and a server's certificate for this machine.
    pub fn new(folder: &Path) -> Self {
        let authority = Self(folder.to_owned());
        fs::write(folder.join("index.txt"), "").unwrap();
        fs::write(folder.join("ca.cnf"), authority.database()).unwrap();
        fs::write(folder.join("server.ext"), "subjectAltName=IP:127.0.0.1,DNS:localhost\n").unwrap();
        fs::write(folder.join("client.ext"), "extendedKeyUsage=clientAuth\n").unwrap();
        authority.openssl("req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout ca.key -out ca.pem -subj /CN=authority -days 30");
        authority.issue("server", "127.0.0.1", "server.ext", 30);
        authority.take_back(&[]);
        authority
    }

    /// A client's certificate under `name`, in a file of that name, for so many days from now.
    pub fn client(&self, file: &str, name: &str, days: i32) -> TlsFiles {
        self.issue(file, name, "client.ext", days);
        self.files(file)
    }

    /// Lists certificates as taken back.
    pub fn take_back(&self, files: &[&str]) {
        for file in files {
            self.openssl(&format!("ca -config ca.cnf -revoke {file}.pem"));
        }
        self.openssl("ca -config ca.cnf -gencrl -out revoked.pem");
    }

    pub fn files(&self, file: &str) -> TlsFiles {
        let path = |end: &str| self.0.join(format!("{file}.{end}"));
        TlsFiles { ca: self.0.join("ca.pem"), cert: path("pem"), key: path("key") }
    }

    fn issue(&self, file: &str, name: &str, extensions: &str, days: i32) {
        self.openssl(&format!("req -new -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout {file}.key -out {file}.csr -subj /CN={name}"));
        self.openssl(&format!("x509 -req -in {file}.csr -CA ca.pem -CAkey ca.key -CAcreateserial -out {file}.pem -days {days} -extfile {extensions}"));
    }

    fn database(&self) -> String {
        let folder = self.0.display();
        format!(
            "[ca]\ndefault_ca=d\n[d]\ndatabase={folder}/index.txt\ncertificate={folder}/ca.pem\n\
             private_key={folder}/ca.key\ndefault_md=sha256\ndefault_crl_days=30\nserial={folder}/serial\n"
        )
    }

    fn openssl(&self, arguments: &str) {
        let mut command = Command::new("openssl");
        let output = command.args(arguments.split(' ')).current_dir(&self.0).output().unwrap();
        assert!(output.status.success(), "openssl {arguments}: {}", String::from_utf8_lossy(&output.stderr));
    }
}

pub fn tls(files: &TlsFiles) -> Tls {
    Tls::read(files).unwrap()
}
