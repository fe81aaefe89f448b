//! Who may connect to the built-in broker, and what they may read and write.

use std::fs;
use std::io::Write;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use cosurf_aggregator::broker::{Broker, BrokerSettings, Users, user_line};
use cosurf_link::{
    Login, MqttConfig, MqttTransport, Outgoing, Role, Tls, TlsFiles, Transport, TransportEvent,
};
use cosurf_tests::live::upload;
use cosurf_tests::mosquitto::{Authority, tls};
use cosurf_tests::offers::{broker_address, identity, offer};
use cosurf_wire::{DeviceId, MAX_CHUNK_BYTES, ModelKind, SiteId, Topic};

use crate::ground::Ground;
use crate::raw::{Hello, Raw};
use crate::station::loopback;

const NOT_AUTHORIZED: u8 = 0x87;
const SITE: &str = "site";

/// A file with the users `drone` and `other`, whose passwords are their names backwards.
pub(crate) fn users(folder: &Path) -> std::path::PathBuf {
    let line =
        |name: &str, password: &str| user_line(&DeviceId::new(name).unwrap(), password, [7; 16]).unwrap();
    let path = folder.join("users.txt");
    fs::write(&path, format!("# users\n{}\n\n{}\n", line("drone", "enord"), line("other", "rehto"))).unwrap();
    path
}

fn guarded(folder: &Path) -> Broker {
    let users = Some(Users::read(&users(folder)).unwrap());
    let settings = BrokerSettings { users, site: SiteId::new(SITE).ok(), ..BrokerSettings::default() };
    Broker::start_with(loopback(), settings, |_| ()).unwrap()
}

fn login<'a>(user: &'a str, password: &'a str) -> Hello<'a> {
    Hello { id: "same-id", login: Some((user, password)), ..Hello::default() }
}

#[test]
fn attack_24_only_users_with_their_password_get_in() {
    let folder = tempfile::tempdir().unwrap();
    let broker = guarded(folder.path());
    let code = |hello: &Hello| Raw::hello(broker.address(), hello).1;
    assert_eq!(code(&login("drone", "enord")), 0);
    for wrong in
        [login("drone", "rehto"), login("drone", ""), login("nobody", "enord"), login("house", "enord")]
    {
        assert_eq!(code(&wrong), NOT_AUTHORIZED, "{:?}", wrong.login);
    }
    assert_eq!(code(&Hello { id: "same-id", ..Hello::default() }), NOT_AUTHORIZED, "no password");
    // A password that was right once is still compared.
    assert_eq!([code(&login("drone", "enord")), code(&login("drone", "x"))], [0, NOT_AUTHORIZED]);
}

#[test]
fn a_revoked_user_loses_its_connection_and_gets_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let broker = guarded(folder.path());
    let (mut drone, code) = Raw::hello(broker.address(), &login("drone", "enord"));
    assert_eq!(code, 0);
    let shut_out = broker.revoker();
    shut_out([DeviceId::new("drone").unwrap()].into());
    assert_eq!(drone.farewell(), NOT_AUTHORIZED);
    assert_eq!(Raw::hello(broker.address(), &login("drone", "enord")).1, NOT_AUTHORIZED);
    assert_eq!(Raw::hello(broker.address(), &login("other", "rehto")).1, 0, "others are not concerned");
    shut_out([].into());
    assert_eq!(Raw::hello(broker.address(), &login("drone", "enord")).1, 0, "let in again");
}

#[test]
fn attack_14_a_user_neither_takes_over_nor_writes_as_another() {
    let folder = tempfile::tempdir().unwrap();
    let broker = guarded(folder.path());
    let (mut drone, code) = Raw::hello(broker.address(), &login("drone", "enord"));
    let (mut other, _) = Raw::hello(broker.address(), &login("other", "rehto"));
    assert_eq!(code, 0);
    // Both have the same client id; the first one is still connected.
    assert!(drone.publish("gs/v1/site/drone/state", b"x", true) & 0x80 == 0);
    for topic in ["gs/v1/site/drone/state", "gs/v1/site/drone/up/1/m", "gs/v1/site/global/1/m", "other"] {
        assert_eq!(other.publish(topic, b"x", true), NOT_AUTHORIZED, "{topic}");
    }
    for filter in ["#", "gs/v1/site/drone/dn/#", "gs/v1/site/+/dn/#", "gs/v1/#"] {
        assert_eq!(other.subscribe(filter), NOT_AUTHORIZED, "{filter}");
    }
    for filter in ["gs/v1/site/other/dn/#", "gs/v1/site/global/#", "gs/v1/site/+/flight"] {
        assert_eq!(other.subscribe(filter), 1, "{filter}");
    }
    for topic in ["gs/v1/elsewhere/other/state", "gs/v1/elsewhere/other/flight"] {
        assert_eq!(other.publish(topic, b"x", true), NOT_AUTHORIZED, "{topic}");
    }
    for filter in ["gs/v1/elsewhere/+/flight", "gs/v1/+/+/flight", "gs/v1/elsewhere/other/dn/#"] {
        assert_eq!(other.subscribe(filter), NOT_AUTHORIZED, "{filter}");
    }
}

#[test]
fn a_device_is_told_if_its_password_is_wrong_or_a_topic_is_not_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let broker = guarded(folder.path());
    let connect = |password: &str| {
        let login = Some(Login { user: "drone".to_owned(), password: password.to_owned() });
        let (broker, identity) = (broker_address(broker.address()), identity(Role::Device, "drone"));
        let mut transport =
            MqttTransport::start(MqttConfig { broker, identity, will: None, tls: None, login });
        let first = transport.poll(Duration::from_secs(20)).unwrap();
        let topic = Topic::State { device: DeviceId::new("other").unwrap() }.to_text(&identity.site);
        transport.publish(&Outgoing { topic, payload: vec![1], retain: true }).unwrap();
        (first, transport.poll(Duration::from_secs(20)).unwrap())
    };
    let (first, second) = connect("enord");
    assert_eq!(first, TransportEvent::Connected);
    let denied = "messages under gs/v1/site/other/state are refused: give this participant access";
    assert!(matches!(&second, TransportEvent::Denied { reason } if reason.contains(denied)), "{second:?}");
    let (event, _) = connect("drone");
    assert!(
        matches!(&event, TransportEvent::Disconnected { reason, .. } if reason.contains("password")),
        "{event:?}"
    );
}

/// Runs the aggregator until it ends, at most a few seconds.
fn run(folder: &Path, settings: &str, arguments: &[&str]) -> Output {
    let config = folder.join("aggregator.toml");
    fs::write(&config, format!("site = \"{SITE}\"\nout = \"{}\"\n{settings}", folder.join("out").display()))
        .unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
    let mut child = command
        .args(["run", "--config"])
        .arg(config)
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    std::thread::sleep(Duration::from_millis(500));
    let _ = child.kill();
    child.wait_with_output().unwrap()
}

#[test]
fn attack_24_no_broker_for_everybody_unless_told() {
    let folder = tempfile::tempdir().unwrap();
    let bind = "bind = \"0.0.0.0:0\"\n";
    let refused = run(folder.path(), bind, &[]);
    let error = String::from_utf8(refused.stderr).unwrap();
    assert!(
        refused.status.code() == Some(1) && error.contains("users") && error.contains("open = true"),
        "{error}"
    );
    assert_eq!(error.trim_end().lines().count(), 1, "{error}");
    for (settings, arguments) in [(format!("{bind}open = true\n"), &[][..]), (bind.to_owned(), &["--open"])] {
        let output = run(folder.path(), &settings, arguments);
        let lines = String::from_utf8(output.stdout).unwrap();
        assert!(lines.contains("WARNING"), "{lines} {}", String::from_utf8_lossy(&output.stderr));
    }
    let users = users(folder.path());
    let guarded = run(folder.path(), &format!("{bind}users = \"{}\"\n", users.display()), &[]);
    let lines = String::from_utf8(guarded.stdout).unwrap();
    assert!(lines.contains("connected") && !lines.contains("WARNING"), "{lines}");
    // Settings of the built-in broker do not belong to a broker elsewhere.
    let elsewhere = run(folder.path(), "broker = \"mqtt://127.0.0.1:1\"\nopen = true\n", &[]);
    let error = String::from_utf8(elsewhere.stderr).unwrap();
    assert!(error.contains("open is for the built-in broker"), "{error}");
}

#[test]
fn the_command_password_makes_a_line_of_the_file_of_users() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
    command.args(["password", "drone"]).stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut child = command.spawn().unwrap();
    child.stdin.take().unwrap().write_all(b"secret words\n").unwrap();
    let line = child.wait_with_output().unwrap().stdout;
    let path = folder.path().join("users.txt");
    fs::write(&path, &line).unwrap();
    let users = Some(Users::read(&path).unwrap());
    let broker =
        Broker::start_with(loopback(), BrokerSettings { users, ..BrokerSettings::default() }, |_| ())
            .unwrap();
    assert_eq!(Raw::hello(broker.address(), &login("drone", "secret words")).1, 0);
    fs::write(&path, "drone:secret words\n").unwrap();
    let error = Users::read(&path).unwrap_err().to_string();
    assert!(error.contains("users.txt, line 1") && error.contains("password NAME"), "{error}");
}

/// Connects a device by TLS, and returns the first event.
fn first_event(address: SocketAddr, device: &str, tls: Tls, login: Option<Login>) -> TransportEvent {
    let broker = cosurf_link::BrokerAddress { is_tls: true, ..broker_address(address) };
    let config =
        MqttConfig { broker, identity: identity(Role::Device, device), will: None, tls: Some(tls), login };
    MqttTransport::start(config).poll(Duration::from_secs(20)).unwrap()
}

#[test]
fn a_model_arrives_by_tls_with_a_certificate() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let [drone, thief, lost] = ["drone", "thief", "lost"].map(|name| authority.client(name, name, 30));
    authority.revoke(&["lost"]);
    let file = |name: &str| folder.path().join(name).display().to_string();
    let settings = format!(
        "tls = {{ ca = \"{}\", cert = \"{}\", key = \"{}\", revoked = \"{}\" }}\n",
        file("ca.pem"),
        file("server.pem"),
        file("server.key"),
        file("revoked.pem")
    );
    let ground = Ground::start_with(folder.path(), &settings, true);
    let offer = offer("drone", 1, ModelKind::Local, 1, 30_000, MAX_CHUNK_BYTES as u32);
    upload(ground.broker(), Some(tls(&drone)), identity(Role::Device, "drone"), offer, |_| {}, |_| {});
    // The name in the certificate is that of the device.
    let refused = first_event(ground.address, "drone", tls(&thief), None);
    assert!(
        matches!(&refused, TransportEvent::Disconnected { reason, .. } if reason.contains("refused")),
        "{refused:?}"
    );
    for (name, files) in [("revoked", lost), ("none", TlsFiles { cert: None, key: None, ..drone })] {
        let event = first_event(ground.address, "lost", tls(&files), None);
        assert!(matches!(event, TransportEvent::Disconnected { .. }), "{name}: {event:?}");
    }
}

#[test]
fn a_password_is_enough_if_the_broker_asks_for_no_certificate() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let files = TlsFiles { cert: None, key: None, ..authority.files("server") };
    let settings = format!(
        "users = \"{}\"\ntls = {{ cert = \"{}\", key = \"{}\" }}\n",
        users(folder.path()).display(),
        folder.path().join("server.pem").display(),
        folder.path().join("server.key").display(),
    );
    let ground = Ground::start_with(folder.path(), &settings, true);
    let login = |password: &str| Some(Login { user: "drone".to_owned(), password: password.to_owned() });
    assert_eq!(first_event(ground.address, "drone", tls(&files), login("enord")), TransportEvent::Connected);
    let event = first_event(ground.address, "drone", tls(&files), login("wrong"));
    assert!(matches!(event, TransportEvent::Disconnected { .. }), "{event:?}");
    // Bytes without TLS get no answer.
    let mut plain = Raw::silent(ground.address);
    assert!(
        !plain.try_send(&crate::raw::connect(&Hello::default()))
            || plain.packet().is_none_or(|(kind, _)| kind == 0x15)
    );
}
