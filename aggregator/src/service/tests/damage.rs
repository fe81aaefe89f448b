//! Damage to the files of a service while it does not run. It starts, tells which file it has set aside, and ends with the
//! bytes that it had.

use std::os::unix::fs::PermissionsExt;
use std::process::Command as Program;
use std::sync::mpsc::RecvTimeoutError;
use std::thread;

use super::*;

/// Time in which a service opens its folder. It takes milliseconds; one that waits for a FIFO never does.
const OPENS_IN: Duration = Duration::from_secs(20);

pub(super) type Damage = (&'static str, fn(&Path));

const DAMAGES: [Damage; 6] = [
    ("cut", |path| {
        let bytes = fs::read(path).unwrap();
        fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
    }),
    ("emptied", |path| fs::write(path, "").unwrap()),
    ("garbage", |path| fs::write(path, [0xa5; 300]).unwrap()),
    ("folder", |path| {
        fs::remove_file(path).unwrap();
        fs::create_dir(path).unwrap();
        fs::write(path.join("something"), "in it").unwrap();
    }),
    ("fifo", |path| {
        fs::remove_file(path).unwrap();
        assert!(Program::new("mkfifo").arg(path).status().unwrap().success());
    }),
    ("unreadable", |path| fs::set_permissions(path, fs::Permissions::from_mode(0o000)).unwrap()),
];

/// Damages a file of a service that has merged two models, and starts the service again. Returns its events until the
/// global model is delivered and, if a model was damaged, until that model is stored again.
fn restart_after(file: &str, damage: fn(&Path)) -> Vec<ServiceEvent> {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(41, Faults::NONE);
    let mut drones = delivered_and_stopped(&network, folder.path());
    let [path, ply] = [folder.path().join(file), global_ply(folder.path())];
    let is_model = file.starts_with("models");
    let model = is_model.then(|| fs::read(&path).unwrap());
    let global = fs::read(&ply).unwrap();
    damage(&path);
    let mut ground = opened_in_time(&network, folder.path()).unwrap_or_else(|| panic!("{file}: it hangs"));
    let events = simulate(&network, &mut ground, &mut drones, |events, _| {
        events.contains(&ServiceEvent::Delivered) && (!is_model || count(events, is_stored) == 1)
    });
    assert_eq!(count(&events, is_disk_failure), 0, "{file}: {events:?}");
    assert!(fs::read(&ply).unwrap() == global, "{file}: another global model");
    assert!(model.is_none_or(|model| fs::read(&path).unwrap() == model), "{file}: another model");
    assert!(Merging::read(folder.path()).is_some(), "{file}: no record");
    events
}

fn opened_in_time(network: &MemoryNetwork, folder: &Path) -> Option<Ground> {
    let (say, opened) = mpsc::channel();
    let identity = identity("aggregator", Role::Aggregator);
    let merge = MergeSettings { vouched: true, ..MergeSettings::default() };
    let expected = fleet(&["agent-1", "agent-2"]);
    let folder = folder.to_path_buf();
    let config = ServiceConfig { identity, folder, limits: LIMITS, expected, merge, threads: 1 };
    thread::spawn(move || {
        let _ = say.send(Service::open(config));
    });
    match opened.recv_timeout(OPENS_IN) {
        Ok(service) => Some(Ground { service: service.unwrap(), transport: network.join(&identity) }),
        Err(RecvTimeoutError::Timeout) => None,
        Err(error) => panic!("{error}"),
    }
}

/// Whether this process may read every file, so that none is unreadable.
fn is_root() -> bool {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file");
    fs::write(&path, "").unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o000)).unwrap();
    fs::File::open(path).is_ok()
}

fn is_told(events: &[ServiceEvent], file: &str) -> bool {
    let names_it = |event: &ServiceEvent| {
        let text = event.to_string();
        matches!(event, ServiceEvent::SetAside { .. })
            && text.contains(file)
            && text.contains(".damaged")
            && !text.contains('\n')
    };
    events.iter().filter(|event| names_it(event)).count() == 1
}

fn check(file: &str) {
    for (name, damage) in DAMAGES {
        if name == "unreadable" && is_root() {
            continue;
        }
        let events = restart_after(file, damage);
        assert!(is_told(&events, file), "{file}, {name}: {events:?}");
    }
}

#[test]
fn a_damaged_model_is_set_aside_and_asked_for_again() {
    check("models/agent-1.1.model");
}

/// It had not been merged, so only the name of its file tells that it is missing.
#[test]
fn a_damaged_model_that_no_record_names_is_asked_for_again() {
    let events = restart_after("models/agent-1.1.model", |path| {
        fs::write(path, "").unwrap();
        fs::remove_file(path.parent().unwrap().with_file_name("merged.json")).unwrap();
    });
    assert!(is_told(&events, "agent-1 is asked for it again"), "{events:?}");
}

#[test]
fn a_damaged_revision_is_set_aside_and_made_anew_under_a_higher_number() {
    for (name, damage) in DAMAGES {
        if name == "unreadable" && is_root() {
            continue;
        }
        let events = restart_after("global/aggregator.1.model", damage);
        assert!(is_told(&events, "global/aggregator.1.model"), "{name}: {events:?}");
        // Devices have a revision 1 already.
        let is_second = |event: &ServiceEvent| matches!(event, ServiceEvent::Merged { header, .. } if header.model == ModelId(2));
        assert!(events.iter().any(is_second), "{name}: {events:?}");
    }
}

#[test]
fn damaged_records_are_set_aside_and_made_anew() {
    ["merged.json", "suspects.json", "global.ply", "cameras.json"].into_iter().for_each(check);
}

/// Without its list, withdrawn models of a drone would count again.
#[test]
fn a_list_of_withdrawn_models_that_cannot_be_read_stops_the_start_with_the_remedy() {
    for (name, damage) in DAMAGES {
        if name == "unreadable" && is_root() {
            continue;
        }
        let folder = tempfile::tempdir().unwrap();
        withdraw(folder.path(), &DeviceId::new("agent-1").unwrap()).unwrap();
        damage(&folder.path().join("withdrawn/agent-1"));
        let identity = identity("aggregator", Role::Aggregator);
        let config = ServiceConfig {
            identity,
            folder: folder.path().to_path_buf(),
            limits: LIMITS,
            expected: fleet(&[]),
            merge: MergeSettings::default(),
            threads: 1,
        };
        let (say, opened) = mpsc::channel();
        thread::spawn(move || {
            let _ = say.send(Service::open(config));
        });
        let error = opened.recv_timeout(OPENS_IN).expect(name).unwrap_err().to_string();
        assert!(error.contains("withdrawn/agent-1") && error.contains("forget agent-1"), "{name}: {error}");
    }
}

/// As [`DAMAGES`], and a bit that is flipped, a file that is deleted, one with the content of another, a link that leads
/// nowhere, and a stray file.
pub(super) const SWEPT: [Damage; 8] = [
    ("bit", |path| {
        let mut bytes = fs::read(path).unwrap();
        let middle = bytes.len() / 2;
        if let Some(byte) = bytes.get_mut(middle) {
            *byte ^= 1;
        }
        fs::write(path, bytes).unwrap();
    }),
    DAMAGES[0],
    DAMAGES[1],
    DAMAGES[2],
    ("deleted", |path| fs::remove_file(path).unwrap()),
    ("another's", |path| {
        let is_other = |entry: &fs::DirEntry| entry.path() != path && entry.path().is_file();
        let other = fs::read_dir(path.parent().unwrap()).unwrap().flatten().find(is_other);
        if let Some(other) = other {
            fs::copy(other.path(), path).unwrap();
        }
    }),
    ("stray", |path| {
        let extension = path.extension().unwrap_or_default().to_str().unwrap();
        fs::copy(path, path.with_file_name(format!("stray.7.{extension}"))).unwrap();
    }),
    ("dead link", |path| {
        fs::remove_file(path).unwrap();
        std::os::unix::fs::symlink("missing", path).unwrap();
    }),
];

/// The files of a folder, relative to `root`, in an order that depends on nothing but their names.
pub(super) fn list_files(root: &Path, folder: &Path, files: &mut Vec<std::path::PathBuf>) {
    let mut entries: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        match path.is_dir() {
            true => list_files(root, &path, files),
            false => files.push(path.strip_prefix(root).unwrap().to_owned()),
        }
    }
}

/// Copies a folder with all that is in it.
pub(super) fn copy(from: &Path, to: &Path) {
    let mut files = Vec::new();
    list_files(from, from, &mut files);
    for file in files {
        fs::create_dir_all(to.join(&file).parent().unwrap()).unwrap();
        fs::copy(from.join(&file), to.join(&file)).unwrap();
    }
}

fn survives(file: &Path, damage: fn(&Path), undamaged: &Path) {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(41, Faults::NONE);
    let mut drones = delivered_and_stopped(&network, folder.path());
    damage(&folder.path().join(file));
    let mut ground = opened_in_time(&network, folder.path()).unwrap_or_else(|| panic!("it hangs"));
    let intact = |name: &str| fs::read(undamaged.join(name)).unwrap();
    let same = |name: &str| fs::read(folder.path().join(name)).is_ok_and(|bytes| bytes == intact(name));
    let models = ["models/agent-1.1.model", "models/agent-2.1.model"];
    let events = simulate(&network, &mut ground, &mut drones, |events, _| {
        events.contains(&ServiceEvent::Delivered)
            && models.iter().all(|model| same(model))
            && same("global.ply")
            && same("cameras.json")
    });
    assert_eq!(count(&events, is_disk_failure), 0, "{events:?}");
    // It runs on: a third drone is merged too.
    drones.push(Drone::new(&network, "agent-3", 1, &model(2, 1, 3.0)));
    let is_stored_too = |events: &[ServiceEvent], _: &[Drone]| count(events, is_stored) > 0;
    simulate(&network, &mut ground, &mut drones, is_stored_too);
}

/// Every damage to every file: nothing honest is lost, the global model has the same bytes once the devices have sent
/// again, and the service runs on.
#[test]
fn every_damage_to_every_file_is_survived() {
    let undamaged = tempfile::tempdir().unwrap();
    delivered_and_stopped(&MemoryNetwork::new(41, Faults::NONE), undamaged.path());
    let mut files = Vec::new();
    list_files(undamaged.path(), undamaged.path(), &mut files);
    assert!(files.len() >= 8, "{files:?}");
    for (file, (name, damage)) in files.iter().flat_map(|file| SWEPT.map(|damage| (file, damage))) {
        println!("{}: {name}", file.display());
        survives(file, damage, undamaged.path());
    }
}
