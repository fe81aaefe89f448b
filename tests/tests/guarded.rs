//! Missions over guarded brokers: with the keys of `pki` as OPERATING.md writes them, with passwords, and by WebSocket
//! over TLS. Each one ends with the same global model as a mission on an open broker.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_tests::datasets::write_city;
use cosurf_tests::mosquitto::{Authority, Mosquitto, example};
use cosurf_tests::programs::program;
use cosurf_tests::web_door::WebDoor;
use tempfile::TempDir;

const AGENTS: [&str; 2] = ["agent-1", "agent-2"];
const PATIENCE: Duration = Duration::from_secs(240);
/// The drone and the addresses in the examples of OPERATING.md.
const DRONE: &str = "drone-1";
const TLS_ADDRESS: &str = "192.168.1.10:8883";
const HOST: &str = "192.168.1.10";

/// The documents that the missions follow.
fn document(name: &str) -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/docs").join(name)).unwrap()
}

/// The block of code in OPERATING.md that contains `part`.
fn block(part: &str) -> String {
    let text = document("OPERATING.md");
    let mut blocks = text.split("```").skip(1).step_by(2);
    let block = blocks.find(|block| block.contains(part)).unwrap_or_else(|| panic!("no block has {part}"));
    block.split_once('\n').unwrap().1.to_owned()
}

/// Pictures of a small city, made once.
fn data() -> &'static Path {
    static DATA: OnceLock<TempDir> = OnceLock::new();
    DATA.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        write_city(folder.path(), 60.0, 8, [96, 72]);
        folder
    })
    .path()
}

fn views(agent: usize) -> String {
    let mut names: Vec<String> = fs::read_dir(data().join("images"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    let own = names.iter().enumerate().filter(|(view, _)| view % AGENTS.len() == agent);
    own.map(|(_, name)| format!("\"{name}\"")).collect::<Vec<_>>().join(", ")
}

/// A program that is killed when this value is dropped.
struct Part {
    child: Child,
    log: PathBuf,
}

impl Part {
    fn start(name: &str, config: &Path) -> Self {
        let log = config.with_extension("log");
        let [out, err] = [(); 2].map(|()| fs::File::options().create(true).append(true).open(&log).unwrap());
        let mut command = Command::new(program(name));
        // Paths in a configuration are relative to the folder in which the program starts.
        command.current_dir(config.parent().unwrap());
        command.args(["run", "--config"]).arg(config).stdin(Stdio::null()).stdout(out).stderr(err);
        Self { child: command.spawn().unwrap(), log }
    }

    fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap()
    }

    /// Waits for the program to end well.
    fn wait(&mut self) {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                assert!(status.success(), "{}: {}", self.log.display(), self.log());
                return;
            }
            assert!(begun.elapsed() < PATIENCE, "{} does not end: {}", self.log.display(), self.log());
            sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Flies a mission with these lines about the broker in the configuration files. Returns the global model as the agents
/// have it.
fn fly(folder: &Path, ground: &str, agent: impl Fn(&str) -> String) -> Vec<u8> {
    let at = |name: &str| folder.join(name);
    let config = |name: &str, text: String| {
        let path = at(&format!("{name}.toml"));
        fs::write(&path, text).unwrap();
        path
    };
    let out = at("ground").display().to_string();
    let text = format!("site = \"site\"\nout = \"{out}\"\nquorum = 2\nquiet_s = 0\n{ground}");
    let station = Part::start("cosurf-aggregator", &config("aggregator", text));
    let mut agents: Vec<Part> = AGENTS
        .iter()
        .enumerate()
        .map(|(index, name)| {
            let text = format!(
                "device = \"{name}\"\nsite = \"site\"\ndata = \"{}\"\nout = \"{}\"\nsteps = 30\nviews = [{}]\n\
                 threads = 1\nwait_global = true\n{}",
                data().display(),
                at(name).display(),
                views(index),
                agent(name)
            );
            Part::start("cosurf-agent", &config(name, text))
        })
        .collect();
    agents.iter_mut().for_each(Part::wait);
    drop(station);
    let [first, second] = AGENTS.map(|name| fs::read(at(name).join("global.ply")).unwrap());
    assert!(first == second, "the agents have different global models");
    first
}

/// A free port of this computer.
fn free_address() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

/// The global model of a mission on an open broker.
fn expected() -> &'static [u8] {
    static GLOBAL: OnceLock<Vec<u8>> = OnceLock::new();
    GLOBAL.get_or_init(|| {
        let (folder, address) = (tempfile::tempdir().unwrap(), free_address());
        let ground = format!("bind = \"{address}\"\n");
        fly(folder.path(), &ground, |_| format!("broker = \"mqtt://{address}\"\n"))
    })
}

/// Makes the keys of a site with the command in OPERATING.md, and copies them to where its examples expect them. Returns
/// the lines for an agent's configuration, as they are written there.
fn keys(folder: &Path, address: &str) -> impl Fn(&str) -> String {
    let command = block("cosurf-aggregator pki keys --host");
    let words = command.replace(HOST, "127.0.0.1").replace(DRONE, AGENTS[0]).replace("drone-2", AGENTS[1]);
    let mut words = words.split_whitespace();
    assert_eq!(words.next(), Some("cosurf-aggregator"));
    let mut command = Command::new(program("cosurf-aggregator"));
    let output = command.args(words).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    for part in ["broker", "aggregator", AGENTS[0], AGENTS[1]] {
        copy(&folder.join("keys").join(part), &folder.join(part));
    }
    let (lines, address) = (block("sign.key"), address.to_owned());
    move |name| lines.replace(DRONE, name).replace(TLS_ADDRESS, &address)
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, to.join(path.file_name().unwrap())).unwrap();
    }
}

/// The aggregator's lines, without those that only `agent.toml` has.
fn of_aggregator(lines: &str) -> String {
    lines
        .lines()
        .filter(|line| !line.contains("only in agent.toml"))
        .map(|line| format!("{line}\n"))
        .collect()
}

#[test]
fn by_mosquitto_with_the_keys_of_pki() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // Mosquitto's certificate names only the host, so its port may be known later.
    let lines = keys(folder, "PORT");
    let settings = example(folder);
    let settings =
        ["ca.pem", "server.pem", "server.key", "revoked.pem"].iter().fold(settings, |text, file| {
            text.replace(&format!("FOLDER/{file}"), &format!("FOLDER/broker/{file}"))
        });
    let Some(broker) = Mosquitto::start(folder, &settings, true) else { return };
    let address = broker.address.to_string();
    let at = |name: &str| lines(name).replace("PORT", &address);
    assert!(fly(folder, &of_aggregator(&at("aggregator")), at) == expected(), "another global model");
}

#[test]
fn by_the_built_in_broker_with_the_keys_of_pki() {
    let (folder, address) = (tempfile::tempdir().unwrap(), free_address());
    let lines = keys(folder.path(), &address);
    let ground = of_built_in_broker(&lines, &address);
    assert!(fly(folder.path(), &ground, lines) == expected(), "another global model");
}

/// With keys, agents leave ground to each other as far as the aggregator confirms their flights.
#[test]
fn by_the_built_in_broker_with_the_keys_of_pki_shared_ground_is_sent_once() {
    let (folder, address) = (tempfile::tempdir().unwrap(), free_address());
    let lines = keys(folder.path(), &address);
    let ground = of_built_in_broker(&lines, &address);
    fly(folder.path(), &ground, |name| format!("compress = true\n{}", lines(name)));
    let dropped = AGENTS.map(|name| {
        let log = fs::read_to_string(folder.path().join(name).with_extension("log")).unwrap();
        let line = log.lines().find(|line| line.contains("that other agents observed better")).unwrap();
        assert!(line.ends_with("(1 other agent known)"), "{line}");
        let words: Vec<&str> = line.split(' ').collect();
        let place = words.iter().position(|word| *word == "dropped").unwrap();
        words[place + 1].parse::<usize>().unwrap()
    });
    assert!(dropped.iter().sum::<usize>() > 0, "{dropped:?}");
}

/// The lines of an aggregator with a broker of its own and the keys of `pki`.
fn of_built_in_broker(lines: impl Fn(&str) -> String, address: &str) -> String {
    // Its own lines stand in for `broker` and the client's `tls`.
    let signed: String = of_aggregator(&lines("aggregator"))
        .lines()
        .filter(|line| line.starts_with("key") || line.starts_with("trusted"))
        .map(|line| format!("{line}\n"))
        .collect();
    format!("bind = \"{address}\"\n{}{signed}", block("broker/server.pem"))
}

/// Writes a password file for each name, and returns the lines that the command `password` prints.
fn passwords(folder: &Path, names: &[&str]) -> String {
    let line = |name: &&str| {
        let password = format!("{name}'s own word");
        fs::write(folder.join(format!("{name}.password")), format!("{password}\n")).unwrap();
        let mut command = Command::new(program("cosurf-aggregator"));
        command.args(["password", name]).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        child.stdin.take().unwrap().write_all(password.as_bytes()).unwrap();
        String::from_utf8(child.wait_with_output().unwrap().stdout).unwrap()
    };
    names.iter().map(line).collect()
}

#[test]
fn by_the_built_in_broker_with_passwords_only() {
    let (folder, address) = (tempfile::tempdir().unwrap(), free_address());
    fs::write(folder.path().join("users.txt"), passwords(folder.path(), &AGENTS)).unwrap();
    let ground = format!("bind = \"{address}\"\nusers = \"users.txt\"\n");
    let agent = |name: &str| format!("broker = \"mqtt://{address}\"\npassword_file = \"{name}.password\"\n");
    assert!(fly(folder.path(), &ground, agent) == expected(), "another global model");
}

#[test]
fn by_mosquitto_over_web_socket_with_passwords() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let server = Authority::new(folder).files("server");
    let names = [&["aggregator"], &AGENTS[..]].concat();
    passwords(folder, &names);
    for (index, name) in names.iter().enumerate() {
        let mut command = Command::new("mosquitto_passwd");
        command.args(if index == 0 { &["-c", "-b"][..] } else { &["-b"] }).arg("mosquitto.passwords");
        command.arg(name).arg(format!("{name}'s own word")).current_dir(folder);
        assert!(command.status().unwrap().success());
    }
    let settings =
        "listener PORT 127.0.0.1\nallow_anonymous false\npassword_file FOLDER/mosquitto.passwords\n";
    let Some(broker) = Mosquitto::start(folder, settings, false) else { return };
    let (cert, key) = (server.cert.unwrap(), server.key.unwrap());
    let Some(door) = WebDoor::start(&broker.address, Some((&cert, &key))) else { return };
    let lines = |name: &str| {
        let url = String::from(door.address.clone());
        format!("broker = \"{url}\"\ntls = {{ ca = \"ca.pem\" }}\npassword_file = \"{name}.password\"\n")
    };
    assert!(fly(folder, &lines("aggregator"), lines) == expected(), "another global model");
}
