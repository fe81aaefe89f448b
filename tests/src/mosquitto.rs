//! Runs the broker Mosquitto as a child process, and makes certificates for it.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cosurf_link::{BrokerAddress, Tls, TlsFiles};

use crate::skips::skip;

/// Settings of a broker without passwords and without TLS. It saves its state every second.
pub const PLAIN: &str = "listener PORT 127.0.0.1\nallow_anonymous true\npersistence true\n\
                         persistence_location FOLDER/\nautosave_interval 1\nset_tcp_nodelay true\n";

/// The example configuration in `shared/docs`, with the placeholders `PORT` and `FOLDER` in place of its port and paths.
/// Writes its access list, for the site `site`, to `folder`.
pub fn example(folder: &Path) -> String {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/docs");
    let text = fs::read_to_string(docs.join("mosquitto.conf")).unwrap();
    let list = fs::read_to_string(docs.join("cosurf.acl")).unwrap();
    fs::write(folder.join("cosurf.acl"), list.replace("quarry", "site")).unwrap();
    for line in ["listener 8883", "/etc/mosquitto/certs", "/etc/mosquitto", "/var/lib/mosquitto"] {
        assert!(text.contains(line), "{line}");
    }
    text.replace("listener 8883", "listener PORT 127.0.0.1")
        .replace("/etc/mosquitto/certs", "FOLDER")
        .replace("/etc/mosquitto", "FOLDER")
        .replace("/var/lib/mosquitto", "FOLDER")
}

/// A running Mosquitto with its own folder. It is killed when this value is dropped.
pub struct Mosquitto {
    /// The address at which the broker listens.
    pub address: BrokerAddress,
    config: PathBuf,
    child: Child,
}

impl Mosquitto {
    /// Starts a broker with the configuration `settings`, in which `PORT` and `FOLDER` are replaced by a free port
    /// and by `folder`. If Mosquitto is not installed, reports that the test is skipped and returns `None`; panics
    /// instead if the environment variable `REQUIRE_MOSQUITTO` is set.
    pub fn start(folder: &Path, settings: &str, is_tls: bool) -> Option<Self> {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let root = "user root\n";
        let text = settings.replace("PORT", &port.to_string()).replace("FOLDER", folder.to_str().unwrap());
        let config = folder.join("mosquitto.conf");
        fs::write(&config, format!("{root}{text}")).unwrap();
        let Some(child) = spawn(&config) else {
            skip("REQUIRE_MOSQUITTO", "mosquitto is not installed");
            return None;
        };
        let address = BrokerAddress { is_tls, ..BrokerAddress::plain("127.0.0.1", port) };
        let broker = Self { address, config, child };
        broker.await_port();
        Some(broker)
    }

    /// Kills the broker, so that it neither saves its state nor notifies its clients.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Shuts the broker down in an orderly way.
    pub fn terminate(&mut self) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").arg(id).status().unwrap().success());
        self.child.wait().unwrap();
    }

    /// Lets the broker read its access list again.
    pub fn reload(&self) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args(["-HUP", &id]).status().unwrap().success());
        std::thread::sleep(Duration::from_millis(200));
    }

    /// Starts the broker again on the same port and folder.
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

/// A certificate authority for tests. Its files lie in a folder, and the machine's program `openssl` makes them.
pub struct Authority(PathBuf);

impl Authority {
    /// Creates an authority and a server certificate for this machine, `server.pem`.
    pub fn new(folder: &Path) -> Self {
        let authority = Self(folder.to_owned());
        fs::write(folder.join("index.txt"), "").unwrap();
        fs::write(folder.join("crlnumber"), "01\n").unwrap();
        fs::write(folder.join("ca.cnf"), authority.configuration()).unwrap();
        fs::write(folder.join("server.ext"), "subjectAltName=IP:127.0.0.1,DNS:localhost\n").unwrap();
        fs::write(folder.join("client.ext"), "extendedKeyUsage=clientAuth\n").unwrap();
        authority.openssl("req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout ca.key -out ca.pem -subj /CN=authority -days 30");
        authority.issue("server", "127.0.0.1", "server.ext", 30);
        authority.revoke(&[]);
        authority
    }

    /// Issues a client certificate for the common name `name`, valid for `days` from now. Its file is `file` with the
    /// extension `.pem`.
    pub fn client(&self, file: &str, name: &str, days: i32) -> TlsFiles {
        self.issue(file, name, "client.ext", days);
        self.files(file)
    }

    /// Revokes the certificates with these file names (without extension), and writes the list of all revoked
    /// certificates to `revoked.pem`.
    pub fn revoke(&self, files: &[&str]) {
        for file in files {
            self.openssl(&format!("ca -config ca.cnf -revoke {file}.pem"));
        }
        self.openssl("ca -config ca.cnf -gencrl -out revoked.pem");
    }

    /// The paths of a certificate, of its key, and of the authority's own certificate.
    pub fn files(&self, file: &str) -> TlsFiles {
        let path = |end: &str| self.0.join(format!("{file}.{end}"));
        TlsFiles { ca: self.0.join("ca.pem"), cert: Some(path("pem")), key: Some(path("key")) }
    }

    fn issue(&self, file: &str, name: &str, extensions: &str, days: i32) {
        self.openssl(&format!("req -new -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout {file}.key -out {file}.csr -subj /CN={name}"));
        self.openssl(&format!("x509 -req -in {file}.csr -CA ca.pem -CAkey ca.key -CAcreateserial -out {file}.pem -days {days} -extfile {extensions}"));
    }

    fn configuration(&self) -> String {
        let folder = self.0.display();
        format!(
            "[ca]\ndefault_ca=d\n[d]\ndatabase={folder}/index.txt\ncertificate={folder}/ca.pem\n\
             private_key={folder}/ca.key\ndefault_md=sha256\ndefault_crl_days=30\nserial={folder}/serial\ncrlnumber={folder}/crlnumber\n"
        )
    }

    fn openssl(&self, arguments: &str) {
        let mut command = Command::new("openssl");
        let output = command.args(arguments.split(' ')).current_dir(&self.0).output().unwrap();
        assert!(output.status.success(), "openssl {arguments}: {}", String::from_utf8_lossy(&output.stderr));
    }
}

/// Reads the certificates and the key for a connection. Panics on an error.
pub fn tls(files: &TlsFiles) -> Tls {
    Tls::read(files).unwrap()
}
