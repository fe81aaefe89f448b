//! What an agent tells at once: a wrong broker, certificate, password or port before it trains, and how far it is while it
//! trains.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

use cosurf_contract::{AgentPhase, AgentStatus};
use cosurf_link::TlsFiles;
use cosurf_scene::{Dataset, Picture};
use cosurf_tests::datasets::write_city;
use cosurf_tests::dice::Dice;
use cosurf_tests::mosquitto::{Authority, Mosquitto, PLAIN, example};
use cosurf_tests::programs::program;
use cosurf_tests::skips::skip;

/// What is wrong must be told in this time.
const AT_ONCE: Duration = Duration::from_secs(5);
/// The agent's line at the start of its training.
const TRAINING: &str = "training views";

/// A running agent. It is killed when this value is dropped.
struct Agent {
    child: Child,
    lines: Receiver<String>,
    begun: Instant,
}

impl Agent {
    /// Starts an agent with these lines about its connection.
    fn start(folder: &Path, connection: &str, steps: u32) -> Self {
        prepare(folder, connection, steps);
        Self::spawn(folder, Command::new(program("cosurf-agent")))
    }

    /// Starts the agent of a prepared folder with `command`, which gets the arguments.
    fn spawn(folder: &Path, mut command: Command) -> Self {
        command.args(["run", "--config", "agent.toml"]);
        Self::spawn_with(folder, command)
    }

    /// Starts the agent of a prepared folder with a command that has its arguments.
    fn spawn_with(folder: &Path, mut command: Command) -> Self {
        let begun = Instant::now();
        command.current_dir(folder).env_remove("XDG_RUNTIME_DIR").stdin(Stdio::null());
        Self::of(command, begun)
    }

    /// Starts a command whose folder and input are set.
    fn of(mut command: Command, begun: Instant) -> Self {
        let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
        let (say, lines) = channel();
        let stderr = BufReader::new(child.stderr.take().unwrap());
        spawn(move || stderr.lines().map_while(Result::ok).for_each(|line| _ = say.send(line)));
        Self { child, lines, begun }
    }

    /// Waits for the line with `part`, at most so long.
    fn tells_within(&self, part: &str, limit: Duration) {
        let end = Instant::now() + limit;
        let mut heard = Vec::new();
        while let Ok(line) = self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
            if line.contains(part) {
                return;
            }
            heard.push(line);
        }
        panic!("{part:?} is not told within {limit:?}: {heard:#?}");
    }

    /// Waits until the agent tells `part`, which must be at once and before it trains.
    fn tells(&self, part: &str) {
        let mut heard = Vec::new();
        while let Ok(line) = self.lines.recv_timeout(AT_ONCE.saturating_sub(self.begun.elapsed())) {
            if line.contains(part) {
                println!("{:.1?}: {line}", self.begun.elapsed());
                return;
            }
            assert!(!line.contains(TRAINING), "it trains before it tells {part:?}: {heard:#?}");
            heard.push(line);
        }
        panic!("{part:?} is not told within {AT_ONCE:?}: {heard:#?}");
    }
}

impl Drop for Agent {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A running aggregator. It is killed when this value is dropped.
struct Ground(Child);

impl Drop for Ground {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Writes a city and the configuration of an agent, unless the city is there. Removes what an earlier agent wrote.
fn prepare(folder: &Path, connection: &str, steps: u32) {
    let data = folder.join("data");
    if !data.exists() {
        write_city(&data, 60.0, 8, [96, 72]);
    }
    let text = format!(
        "device = \"drone\"\nsite = \"site\"\ndata = \"data\"\nout = \"out\"\nsteps = {steps}\nthreads = 1\n\
         compute = \"cpu\"\n{connection}"
    );
    fs::write(folder.join("agent.toml"), text).unwrap();
    let _ = fs::remove_dir_all(folder.join("out"));
}

/// The lines for a broker with TLS.
fn with_tls(port: u16, files: &TlsFiles) -> String {
    let path = |path: &Path| path.display().to_string();
    let mut lines = format!("broker = \"mqtts://127.0.0.1:{port}\"\n[tls]\nca = \"{}\"\n", path(&files.ca));
    if let (Some(cert), Some(key)) = (&files.cert, &files.key) {
        lines += &format!("cert = \"{}\"\nkey = \"{}\"\n", path(cert), path(key));
    }
    lines
}

#[test]
fn a_wrong_port_host_or_serial_device_is_told_before_the_training() {
    let folder = tempfile::tempdir().unwrap();
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let web = other.local_addr().unwrap();
    spawn(move || {
        for connection in other.incoming() {
            let mut connection = connection.unwrap();
            let _ = connection.read(&mut [0; 1024]);
            let _ = connection.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n");
        }
    });
    let cases = [
        (format!("broker = \"mqtt://{free}\""), "refused"),
        ("broker = \"mqtt://no-such-host.invalid:1883\"".into(), "no-such-host.invalid"),
        (format!("broker = \"mqtt://{}\"", silent.local_addr().unwrap()), "check the address"),
        (format!("broker = \"mqtt://{web}\""), "no MQTT broker"),
        (format!("broker = \"mqtts://{web}\""), "mqtt://"),
        ("serial = \"/dev/no-radio\"".into(), "/dev/no-radio"),
        ("serial = \"agent.toml\"".into(), "is no serial port"),
    ];
    for (connection, told) in cases {
        Agent::start(folder.path(), &connection, 100_000).tells(told);
    }
}

#[test]
fn a_wrong_certificate_or_password_is_told_before_the_training() {
    let (folder, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let folder = folder.path();
    let authority = Authority::new(folder);
    let good = authority.client("good", "drone", 30);
    let late = authority.client("late", "drone", -1);
    let other_name = authority.client("other", "another-drone", 30);
    let stranger = Authority::new(elsewhere.path()).client("stranger", "drone", 30);
    let bare = TlsFiles { cert: None, key: None, ..good.clone() };
    let foreign_ca = TlsFiles { ca: stranger.ca.clone(), ..good.clone() };
    let foreign = TlsFiles { ca: good.ca.clone(), ..stranger };
    let Some(guarded) = Mosquitto::start(folder, &example(folder), true) else { return };
    let port = guarded.address.port;
    let mut command = Command::new("mosquitto_passwd");
    command.args(["-c", "-b", "passwords", "drone", "right"]).current_dir(folder);
    assert!(command.status().unwrap().success());
    fs::write(folder.join("wrong"), "wrong\n").unwrap();
    fs::write(folder.join("right"), "right\n").unwrap();
    fs::write(folder.join("acl"), "pattern read gs/v1/site/#\npattern write gs/v1/site/%u/state\n").unwrap();
    let by_password = "listener PORT 127.0.0.1\nallow_anonymous false\npassword_file FOLDER/passwords\nacl_file FOLDER/acl\n";
    let beside = tempfile::tempdir_in(folder).unwrap();
    let settings = by_password.replace("FOLDER", folder.to_str().unwrap());
    let Some(asking) = Mosquitto::start(beside.path(), &settings, false) else { return };
    let at_asking = format!("broker = \"mqtt://127.0.0.1:{}\"\n", asking.address.port);
    let open = tempfile::tempdir_in(folder).unwrap();
    let Some(open) = Mosquitto::start(open.path(), PLAIN, false) else { return };
    let cases = [
        (with_tls(port, &late), "has expired"),
        (with_tls(port, &foreign), "the broker's own authority"),
        (with_tls(port, &foreign_ca), "does not come from this authority"),
        (with_tls(port, &bare), "certificate"),
        (with_tls(port, &other_name), "its name must be that of its certificate"),
        (format!("broker = \"mqtt://127.0.0.1:{port}\""), "mqtts://"),
        (with_tls(open.address.port, &good), "mqtt://"),
        (at_asking.clone(), "password"),
        (format!("{at_asking}password_file = \"wrong\""), "password"),
        (format!("{at_asking}password_file = \"right\""), "access"),
    ];
    for (connection, told) in cases {
        Agent::start(folder, &connection, 100_000).tells(told);
    }
}

/// The status is there for whoever subscribes, within five seconds of the agent's start and every five seconds.
#[test]
fn how_far_an_agent_is_can_be_seen_at_the_broker() {
    let folder = tempfile::tempdir().unwrap();
    let Some(broker) = Mosquitto::start(folder.path(), PLAIN, false) else { return };
    let port = broker.address.port.to_string();
    let mut command = Command::new("mosquitto_sub");
    command.args(["-p", &port, "-t", "gs/v1/site/drone/status"]).stdout(Stdio::piped());
    let mut subscriber = command.spawn().unwrap();
    let (say, statuses) = channel();
    let stdout = BufReader::new(subscriber.stdout.take().unwrap());
    spawn(move || stdout.lines().map_while(Result::ok).for_each(|line| _ = say.send((Instant::now(), line))));

    let agent = Agent::start(folder.path(), &format!("broker = \"mqtt://127.0.0.1:{port}\""), 100_000);
    let (mut before, mut seen) = (agent.begun, Vec::new());
    while agent.begun.elapsed() < Duration::from_secs(17) {
        let (at, line) = statuses.recv_timeout(AT_ONCE + Duration::from_secs(1)).unwrap();
        assert!(at - before < AT_ONCE + Duration::from_secs(1), "{:?} without a status", at - before);
        before = at;
        seen.push(serde_json::from_str::<AgentStatus>(&line).unwrap());
    }
    let interrupt = Command::new("kill").args(["-INT", &agent.child.id().to_string()]).status();
    assert!(interrupt.unwrap().success());
    let end = loop {
        let (_, line) = statuses.recv_timeout(AT_ONCE + Duration::from_secs(1)).expect("its end is told");
        let status = serde_json::from_str::<AgentStatus>(&line).unwrap();
        if status.phase == AgentPhase::Failed {
            break status;
        }
    };
    assert!(end.problem.as_ref().is_some_and(|problem| problem.contains("stopped at step")), "{end:?}");
    subscriber.kill().unwrap();
    subscriber.wait().unwrap();
    assert_eq!(seen[0].phase, AgentPhase::Loading, "{seen:?}");
    let last = seen.last().unwrap();
    assert!(last.phase == AgentPhase::Training && last.step > 0 && last.steps == 100_000, "{last:?}");
    assert!(last.psnr.is_some() && last.splats > 0 && last.memory_bytes > 1 << 20, "{last:?}");
}

/// A shell with mounts of its own, which gets a script next; `None` if `mount` fails in it, and the test is skipped.
#[cfg(target_os = "linux")]
fn alone(folder: &Path, mount: &str) -> Option<Command> {
    let shell = || {
        let mut command = Command::new("unshare");
        command.args(["--user", "--map-root-user", "--mount", "sh", "-c"]).current_dir(folder);
        command
    };
    let can_mount = shell().arg(mount).status().is_ok_and(|status| status.success());
    if !can_mount {
        skip("REQUIRE_MOUNTS", "this computer allows no mounts of one's own");
    }
    can_mount.then(shell)
}

/// A mount that only the agent sees makes its folder a small disk, without the rights of an administrator.
#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_is_told_before_the_training() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path(), "serial = \"/dev/no-radio\"", 100_000);
    fs::create_dir(folder.path().join("out")).unwrap();
    let mount = "mount -t tmpfs -o size=64k tmpfs out";
    let Some(mut command) = alone(folder.path(), mount) else { return };
    command.arg(format!("{mount} && exec \"$0\" \"$@\"")).arg(program("cosurf-agent"));
    Agent::spawn(folder.path(), command).tells("free some");
}

/// In /proc, nobody may create files, administrators neither.
#[test]
#[cfg(target_os = "linux")]
fn a_folder_in_which_no_file_may_be_created_is_told_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let without_rights = |name: &str| {
        prepare(folder.path(), "serial = \"/dev/no-radio\"", 100_000);
        fs::create_dir(folder.path().join("out")).unwrap();
        std::os::unix::fs::symlink("/proc/self", folder.path().join("out").join(name)).unwrap();
    };
    for name in ["checkpoint", "global"] {
        without_rights(name);
        Agent::spawn(folder.path(), Command::new(program("cosurf-agent"))).tells(&format!("out/{name}: "));
    }
    let bind = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let aggregator = format!("site = \"s\"\nout = \"out\"\nbind = \"{bind}\"\n");
    fs::write(folder.path().join("aggregator.toml"), aggregator).unwrap();
    for name in ["models", "parts", "global", "tiles", "sent", "handed"] {
        without_rights(name);
        let mut command = Command::new(program("cosurf-aggregator"));
        command.arg("run");
        Agent::spawn_with(folder.path(), command).tells(&format!("out/{name}: "));
    }
}

/// Goal: a disk that fills during a training does not end it. Method: the disk is filled once the training has begun, and
/// emptied when the agent has tried twice to write.
#[test]
#[cfg(target_os = "linux")]
fn a_disk_that_fills_holds_a_training_up_until_there_is_room() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path(), "", 1);
    fs::create_dir(folder.path().join("out")).unwrap();
    let mount = "mount -t tmpfs -o size=8m tmpfs out";
    let script =
        "timeout 100 \"$0\" train data --out out --steps 900 --compute cpu --threads 1 --json > log 2>&1 &
        until grep -q started log; do sleep 0.05; done
        dd if=/dev/zero of=out/filling bs=1k 2> /dev/null
        until grep -q '\"attempt\":2' log || ! kill -0 $!; do sleep 0.1; done
        rm out/filling
        wait $! && test -s out/model.ply && test -s out/report.json";
    let Some(mut command) = alone(folder.path(), mount) else { return };
    command.arg(format!("{mount} || exit\n{script}")).arg(program("cosurf-agent"));
    let status = command.status().unwrap();
    let log = fs::read_to_string(folder.path().join("log")).unwrap_or_default();
    assert!(status.success() && log.contains("the disk is full"), "{log}");
}

#[test]
fn a_second_program_in_a_folder_is_told_who_uses_it() {
    let folder = tempfile::tempdir().unwrap();
    let first = Agent::start(folder.path(), "serial = \"/dev/no-radio\"", 100_000);
    first.tells("/dev/no-radio");
    let second = Agent::spawn(folder.path(), Command::new(program("cosurf-agent")));
    second.tells(&format!("in use by cosurf-agent run, process {}", first.child.id()));

    let bind = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    fs::write(
        folder.path().join("aggregator.toml"),
        format!("site = \"s\"\nout = \"out\"\nbind = \"{bind}\"\n"),
    )
    .unwrap();
    for command in [&["run"][..], &["mission", "--out", "out"], &["merge", "a", "b", "--out", "out"]] {
        let mut program = Command::new(program("cosurf-aggregator"));
        let output = program.args(command).current_dir(folder.path()).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(
            !output.status.success() && told.contains("in use by cosurf-agent run"),
            "{command:?}: {told}"
        );
    }
}

#[test]
fn a_merge_does_not_replace_the_cameras_of_a_training() {
    let folder = tempfile::tempdir().unwrap();
    let trained = folder.path().join("trained");
    fs::create_dir(&trained).unwrap();
    fs::write(trained.join("model.ply"), "ply").unwrap();
    let mut merge = Command::new(program("cosurf-aggregator"));
    let output =
        merge.args(["merge", "trained", "--out", "trained"]).current_dir(folder.path()).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && told.contains("holds the model of a training"), "{told}");
}

#[test]
fn two_pictures_are_too_few_and_a_driver_says_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let views = "views = [\"0000.jpg\", \"0001.jpg\"]\n";
    prepare(folder.path(), &format!("{views}serial = \"/dev/no-radio\""), 100);
    let agent = Agent::spawn(folder.path(), Command::new(program("cosurf-agent")));
    agent.tells("2 views to train on");
    let mut devices = Command::new(program("cosurf-agent"));
    let output = devices.arg("devices").env_remove("XDG_RUNTIME_DIR").output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && told.is_empty(), "{told}");
}

/// A picture that is held out is read only after the training.
#[test]
fn a_held_out_picture_that_is_cut_short_is_told_before_the_training() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path(), "serial = \"/dev/no-radio\"", 100);
    let held_out = folder.path().join("data/images/0000.jpg");
    let bytes = fs::read(&held_out).unwrap();
    fs::write(&held_out, &bytes[..bytes.len() / 2]).unwrap();
    let mut train = Command::new(program("cosurf-agent"));
    train.args(["train", "data", "--out", "out", "--steps", "100000", "--compute", "cpu"]);
    train.current_dir(folder.path());
    Agent::of(train, Instant::now()).tells("it was cut short");
}

/// Pictures that have nothing to do with their poses.
#[test]
fn a_training_that_learns_nothing_fails_and_leaves_its_model() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    write_city(&data, 40.0, 16, [80, 60]);
    let mut dice = Dice(1);
    for view in Dataset::open(&data).unwrap().views {
        let noise = (0..3 * 80 * 60).map(|_| dice.below(256) as u8).collect();
        Picture::new([80, 60], noise).write_jpeg(&view.path, 90).unwrap();
    }
    let mut train = Command::new(program("cosurf-agent"));
    train.args(["train", "data", "--out", "out", "--steps", "100", "--compute", "cpu"]);
    let output = train.current_dir(folder.path()).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && told.contains("nothing was learnt"), "{told}");
    assert!(folder.path().join("out/model.ply").is_file());
}

#[test]
fn preflight_tells_whether_a_flight_can_begin() {
    let folder = tempfile::tempdir().unwrap();
    let Some(broker) = Mosquitto::start(folder.path(), PLAIN, false) else { return };
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let aggregate = |site: &str| {
        let text = format!("site = \"{site}\"\nout = \"ground\"\nbroker = \"{}\"\n", broker.address);
        fs::write(folder.path().join("aggregator.toml"), text).unwrap();
        let mut command = Command::new(program("cosurf-aggregator"));
        let command = command.args(["run", "--json"]).current_dir(folder.path());
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
        assert!(lines.any(|line| line.contains("connected")));
        Ground(child)
    };
    let preflight = |connection: &str| {
        prepare(folder.path(), connection, 100);
        let mut command = Command::new(program("cosurf-agent"));
        let output =
            command.args(["preflight", "--config", "agent.toml"]).current_dir(folder.path()).output();
        let output = output.unwrap();
        (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let at_broker = format!("broker = \"mqtt://127.0.0.1:{}\"", broker.address.port);
    let (is_ready, told) = preflight(&at_broker);
    assert!(!is_ready && told.contains("no aggregator of the site site answers drone"), "{told}");
    let elsewhere = aggregate("another-site");
    let (is_ready, told) = preflight(&at_broker);
    assert!(!is_ready && told.contains("check `site`"), "{told}");
    drop(elsewhere);
    let _here = aggregate("site");
    let (is_ready, told) = preflight(&at_broker);
    assert!(is_ready && told.contains("ready: 7 training views of 96 x 72 px, 1 held out"), "{told}");
    assert!(!folder.path().join("out/model.ply").exists(), "it has trained");
    let pictures = folder.path().join("data/images");
    let picture = fs::read_dir(pictures).unwrap().map(|entry| entry.unwrap().path()).max().unwrap();
    let whole = fs::read(&picture).unwrap();
    fs::write(&picture, &whole[..whole.len() - 20]).unwrap();
    let (is_ready, told) = preflight(&at_broker);
    assert!(!is_ready && told.contains("cut short"), "{told}");
    let (is_ready, told) = preflight(&format!("broker = \"mqtt://{free}\""));
    assert!(!is_ready && told.contains("refused") && told.contains("check the address"), "{told}");
    fs::write(&picture, &whole).unwrap();
    let elsewhere = tempfile::tempdir().unwrap();
    let other = Agent::start(elsewhere.path(), &at_broker, 100_000);
    other.tells(TRAINING);
    let (is_ready, told) = preflight(&at_broker);
    assert!(!is_ready && told.contains("another program is connected to the broker as drone"), "{told}");
    drop(other);
}

/// A broker whose access list has the topics of states and not those of models.
#[test]
fn a_broker_that_takes_no_models_is_told_before_the_training() {
    let folder = tempfile::tempdir().unwrap();
    let list = "topic write gs/v1/site/drone/state\ntopic write gs/v1/site/drone/status\n\
                topic write gs/v1/site/drone/flight\ntopic write gs/v1/site/drone/global/#\ntopic read gs/v1/site/#\n";
    fs::write(folder.path().join("list"), list).unwrap();
    let settings = format!("{PLAIN}acl_file FOLDER/list\n");
    let Some(broker) = Mosquitto::start(folder.path(), &settings, false) else { return };
    let at_broker = format!("broker = \"mqtt://127.0.0.1:{}\"", broker.address.port);
    let agent = Agent::start(folder.path(), &at_broker, 100_000);
    agent.tells("up/0/m are refused: give this participant access to its topics");
    agent.tells(TRAINING);
}

/// A broker that takes client ids from certificates or users ends the connection of the running agent when another program
/// connects with its certificate.
#[test]
fn preflight_tells_that_a_name_is_taken_where_the_broker_makes_the_client_ids() {
    let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let settings = format!("use_username_as_clientid true\n{PLAIN}");
    let Some(broker) = Mosquitto::start(folder.path(), &settings, false) else { return };
    let connection =
        format!("broker = \"mqtt://127.0.0.1:{}\"\npassword_file = \"password\"", broker.address.port);
    for folder in [folder.path(), other.path()] {
        fs::write(folder.join("password"), "not asked for").unwrap();
    }
    let running = Agent::start(folder.path(), &connection, 100_000);
    running.tells(TRAINING);
    prepare(other.path(), &connection, 100);
    let preflight = || {
        let mut command = Command::new(program("cosurf-agent"));
        let output = command.args(["preflight", "--config", "agent.toml"]).current_dir(other.path()).output();
        String::from_utf8_lossy(&output.unwrap().stderr).into_owned()
    };
    let told = preflight();
    assert!(told.contains("another program is connected to the broker as drone"), "{told}");
    drop(running);
    let told = preflight();
    assert!(told.contains("no aggregator of the site site answers drone"), "{told}");
}

/// Two programs of one name end each other's connections. Mosquitto does not tell them why.
#[test]
fn two_agents_of_one_name_are_told_so_in_few_lines() {
    let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let Some(broker) = Mosquitto::start(folder.path(), PLAIN, false) else { return };
    let at_broker = format!("broker = \"mqtt://127.0.0.1:{}\"", broker.address.port);
    let first = Agent::start(folder.path(), &at_broker, 100_000);
    first.tells(TRAINING);
    let second = Agent::start(other.path(), &at_broker, 100_000);
    second.tells_within("same name", 2 * AT_ONCE);
    first.tells_within("same name", 2 * AT_ONCE);
    sleep(AT_ONCE);
    let more = first.lines.try_iter().filter(|line| line.contains("broker")).count();
    assert!(more <= 5, "{more} lines in {AT_ONCE:?}");
}

#[test]
fn a_watching_agent_waits_for_pictures_and_then_trains() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path(), "serial = \"/dev/no-radio\"", 3);
    let flights = folder.path().join("flights");
    fs::create_dir(&flights).unwrap();
    let mut command = Command::new(program("cosurf-agent"));
    command.args(["run", "--watch", "flights"]);
    let agent = Agent::spawn_with(folder.path(), command);
    agent.tells("waiting for pictures in flights");
    assert!(agent.lines.recv_timeout(Duration::from_secs(3)).is_err(), "there are no pictures yet");
    for name in ["images", "sparse"] {
        fs::rename(folder.path().join("data").join(name), flights.join(name)).unwrap();
    }
    // Ten seconds without a change, and the rest for busy computers.
    agent.tells_within(TRAINING, Duration::from_secs(40));
    agent.tells_within("/dev/no-radio", Duration::from_secs(20));
    assert!(folder.path().join("out/flight.json").is_file());
}

/// The configuration is edited in the middle of a training: the checkpoint is of pictures of another size.
#[test]
fn a_watching_agent_starts_again_after_a_change_of_settings() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path(), "serial = \"/dev/no-radio\"\nmax_size = 32", 3);
    let start = || {
        let mut command = Command::new(program("cosurf-agent"));
        command.args(["run", "--watch", "data"]);
        Agent::spawn_with(folder.path(), command)
    };
    let agent = start();
    agent.tells_within(TRAINING, Duration::from_secs(40));
    agent.tells_within("/dev/no-radio", Duration::from_secs(20));
    drop(agent);
    let config = folder.path().join("agent.toml");
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("max_size = 32", "max_size = 48")).unwrap();
    let agent = start();
    agent.tells_within("other data or settings", Duration::from_secs(40));
    agent.tells_within(TRAINING, Duration::from_secs(20));
}

/// An empty picture, as a copy that stalls leaves it.
#[test]
fn a_watching_agent_outlasts_a_flight_that_fails() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path(), "serial = \"/dev/no-radio\"", 3);
    let data = folder.path().join("data");
    let picture = fs::read_dir(data.join("images")).unwrap().next().unwrap().unwrap().path();
    let bytes = fs::read(&picture).unwrap();
    fs::write(&picture, "").unwrap();
    let mut command = Command::new(program("cosurf-agent"));
    command.args(["run", "--watch", "data"]);
    let agent = Agent::spawn_with(folder.path(), command);
    agent.tells_within("is empty (0 bytes)", Duration::from_secs(40));
    fs::write(&picture, bytes).unwrap();
    agent.tells_within(TRAINING, Duration::from_secs(40));
}

/// A mission that is killed closes the input of its agents. Without the mission's variable, a closed input says nothing.
#[test]
fn an_agent_ends_with_its_mission() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path(), "serial = \"/dev/no-radio\"", 300_000);
    let start = |is_of_mission: bool| {
        let _ = fs::remove_dir_all(folder.path().join("out"));
        let mut command = Command::new(program("cosurf-agent"));
        command.args(["run", "--config", "agent.toml"]).current_dir(folder.path()).stdin(Stdio::piped());
        if is_of_mission {
            command.env("COSURF_ENDS_WITH_STDIN", "1");
        }
        let mut agent = Agent::of(command, Instant::now());
        agent.tells_within(TRAINING, Duration::from_secs(20));
        drop(agent.child.stdin.take());
        agent
    };
    let agent = start(true);
    agent.tells_within("run the same command again to go on", Duration::from_secs(20));
    assert!(folder.path().join("out/checkpoint/state.bin").is_file());
    drop(agent);
    let mut agent = start(false);
    std::thread::sleep(Duration::from_secs(2));
    assert!(agent.child.try_wait().unwrap().is_none(), "an agent by hand has ended");
}
