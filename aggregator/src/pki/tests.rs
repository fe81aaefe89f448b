#![allow(clippy::unwrap_used)]
use std::collections::BTreeSet;

use cosurf_link::{Credentials, Tls, TlsFiles};
use cosurf_wire::FrameId;

use super::*;

fn wish(devices: &[&str], revoked: &[&str]) -> Wish {
    let names = |names: &[&str]| names.iter().map(|name| DeviceId::new(name).unwrap()).collect();
    Wish {
        hosts: vec!["ground.local".to_owned(), "192.168.1.10".to_owned()],
        aggregator: DeviceId::new("aggregator").unwrap(),
        devices: names(devices),
        revoked: names(revoked),
        days: 30,
    }
}

fn make(folder: &Path, devices: &[&str], revoked: &[&str]) -> Result<Done, PkiError> {
    Pki::open(folder)?.fulfil(&wish(devices, revoked))
}

fn lines(folder: &Path, name: &str, file: &str) -> Vec<String> {
    let text = fs::read_to_string(folder.join(name).join(file)).unwrap();
    text.lines().map(|line| line.rsplit_once(' ').unwrap().0.to_owned()).collect()
}

#[test]
fn each_participant_gets_files_that_the_programs_accept() {
    let folder = tempfile::tempdir().unwrap();
    let done = make(folder.path(), &["drone-1", "drone-2"], &[]).unwrap();
    assert_eq!(done.made.len(), 4, "{done:?}");
    for name in ["aggregator", "drone-1", "drone-2"] {
        let its = |file: &str| folder.path().join(name).join(file);
        Tls::read(&TlsFiles { ca: its("ca.pem"), cert: Some(its("tls.pem")), key: Some(its("tls.key")) })
            .unwrap();
        let (key, trusted, fleet) = (its("sign.key"), its("trusted.txt"), its("fleet.txt"));
        let fleet = (name != "aggregator").then_some(fleet.as_path());
        Credentials::load(FrameId::default(), Some(&key), Some(&trusted), fleet).unwrap();
    }
    assert_eq!(lines(folder.path(), "drone-1", TRUSTED), ["aggregator"]);
    assert_eq!(lines(folder.path(), "drone-1", FLEET), ["drone-1", "drone-2"]);
    assert_eq!(lines(folder.path(), "aggregator", TRUSTED), ["drone-1", "drone-2"]);
}

#[test]
fn a_revoked_participant_is_on_both_lists_and_can_get_new_keys() {
    let folder = tempfile::tempdir().unwrap();
    make(folder.path(), &["drone-1"], &[]).unwrap();
    let error = make(folder.path(), &["drone-1"], &[]).unwrap_err().to_string();
    assert!(error.contains("--revoke drone-1"), "{error}");
    let before = fs::read_to_string(folder.path().join(REVOKED)).unwrap();
    make(folder.path(), &["drone-1"], &["drone-1"]).unwrap();
    let after = fs::read_to_string(folder.path().join("broker").join(REVOKED)).unwrap();
    assert!(after.len() > before.len(), "nothing is revoked in {after}");
    assert_eq!(lines(folder.path(), "aggregator", TRUSTED), ["revoked drone-1", "drone-1"]);
    let keys = fs::read_to_string(folder.path().join("aggregator").join(TRUSTED)).unwrap();
    let keys: BTreeSet<&str> = keys.lines().map(|line| line.rsplit(' ').next().unwrap()).collect();
    assert_eq!(keys.len(), 2, "the new key is the old one");
    assert_eq!(fs::read_dir(folder.path().join(REVOKED_FOLDERS)).unwrap().count(), 1);
}

#[test]
fn a_wish_that_cannot_be_fulfilled_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut homeless = wish(&["drone-1"], &[]);
    homeless.hosts.clear();
    let error = Pki::open(folder.path()).unwrap().fulfil(&homeless).unwrap_err();
    assert!(matches!(error, PkiError::NoHost), "{error}");
    for (devices, revoked) in [(&["drone-1", "broker"][..], &[][..]), (&["drone-1"], &["drone-9"])] {
        let error = make(folder.path(), devices, revoked).unwrap_err();
        assert!(!folder.path().join("drone-1").exists(), "{error}");
    }
    make(folder.path(), &["drone-1"], &[]).unwrap();
}

#[cfg(unix)]
#[test]
fn only_the_user_may_read_secret_keys() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    make(folder.path(), &["drone-1"], &[]).unwrap();
    for file in ["authority.key", "broker/server.key", "drone-1/tls.key", "drone-1/sign.key"] {
        let mode = fs::metadata(folder.path().join(file)).unwrap().permissions().mode();
        assert_eq!(mode & 0o077, 0, "{file}");
    }
}

/// Nothing is changed by a wish that cannot be fulfilled.
#[test]
fn the_brokers_certificate_is_not_revoked() {
    let folder = tempfile::tempdir().unwrap();
    make(folder.path(), &["drone-1"], &[]).unwrap();
    let error = make(folder.path(), &[], &["broker"]).unwrap_err().to_string();
    assert!(error.contains("--host") && error.contains("another folder"), "{error}");
    let error = make(folder.path(), &["broker"], &[]).unwrap_err().to_string();
    assert!(error.contains("broker cannot be the name"), "{error}");
    assert!(folder.path().join("broker/server.pem").exists());
    make(folder.path(), &["drone-2"], &[]).unwrap();
}
