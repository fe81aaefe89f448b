//! The keys that `pki` makes, with Mosquitto and its example configuration: participants get in, revoked ones do not.
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use cosurf_link::{Identity, MqttConfig, MqttTransport, Role, Tls, TlsFiles, Transport, TransportEvent};
use cosurf_tests::live::{Ground, upload};
use cosurf_tests::mosquitto::{Mosquitto, example};
use cosurf_tests::offers::{identity, offer};
use cosurf_wire::{DeviceId, ModelKind};

/// Runs `pki` on the folder `keys`.
fn pki(keys: &Path, options: &[&str]) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
    let output = command.arg("pki").arg(keys).args(options).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn tls(folder: &Path) -> Option<Tls> {
    let its = |file: &str| folder.join(file);
    Some(
        Tls::read(&TlsFiles { ca: its("ca.pem"), cert: Some(its("tls.pem")), key: Some(its("tls.key")) })
            .unwrap(),
    )
}

#[test]
fn participants_get_in_and_revoked_ones_do_not() {
    let folder = tempfile::tempdir().unwrap();
    let keys = folder.path().join("keys");
    pki(&keys, &["--host", "127.0.0.1", "--device", "drone", "--device", "thief"]);
    let conf = example(folder.path()).replace("FOLDER/ca.pem", "FOLDER/keys/broker/ca.pem");
    let conf = ["server.pem", "server.key", "revoked.pem"].iter().fold(conf, |conf, file| {
        conf.replace(&format!("FOLDER/{file}"), &format!("FOLDER/keys/broker/{file}"))
    });
    let Some(mut broker) = Mosquitto::start(folder.path(), &conf, true) else { return };
    let connects = |name: &str, files: &Path, broker: &Mosquitto| {
        let device = DeviceId::new(name).unwrap();
        let identity = Identity { device, ..identity(Role::Device, name) };
        let config =
            MqttConfig { broker: broker.address.clone(), identity, will: None, tls: tls(files), login: None };
        MqttTransport::start(config).poll(Duration::from_secs(20)) == Some(TransportEvent::Connected)
    };
    assert!(connects("thief", &keys.join("thief"), &broker));
    let ground = identity(Role::Aggregator, "aggregator");
    let ground = Ground::start(broker.address.clone(), tls(&keys.join("aggregator")), ground);
    let model = offer("drone", 1, ModelKind::Local, 1, 2_000, 65_536);
    let body = model.body.clone();
    let drone = identity(Role::Device, "drone");
    upload(broker.address.clone(), tls(&keys.join("drone")), drone, model, |_| {}, |_| {});
    assert_eq!(*ground.bodies.lock().unwrap(), [body]);
    drop(ground);

    pki(&keys, &["--revoke", "thief"]);
    broker.terminate();
    broker.start_again();
    let revoked = std::fs::read_dir(keys.join("revoked")).unwrap().next().unwrap().unwrap().path();
    assert!(!connects("thief", &revoked, &broker), "a revoked participant got in");
    assert!(connects("drone", &keys.join("drone"), &broker), "an honest one is kept out");
    pki(&keys, &["--device", "thief"]);
    assert!(connects("thief", &keys.join("thief"), &broker), "new keys do not work");
}
