//! Fuzzes the readers of files that the programs keep or are told to read: models, recordings, keys, users, settings and
//! the heads of checkpoints.

use std::fs;
use std::time::Duration;

use cosurf_agent::checkpoint::{self, Checkpoint};
use cosurf_aggregator::broker::{Users, user_line};
use cosurf_aggregator::service::AggregatorConfig;
use cosurf_contract::{AgentConfig, parse_toml};
use cosurf_link::recording::{Entry, Recorder, Recording};
use cosurf_link::{ModelKey, ModelStore, Offer, Trusted};
use cosurf_tests::keys::key_of;
use cosurf_tests::models::{cameras, random_splats};
use cosurf_wire::{DeviceId, ModelId, ModelKind};

use crate::files::{FILE_BYTES_MAX, folder};
use crate::runner::{Target, hammer};

fn target(name: &str, samples: Vec<Vec<u8>>, reseal: fn(&mut [u8])) -> Target<'_> {
    Target { name, samples, reseal, bytes_max: FILE_BYTES_MAX }
}

/// Recomputes the checksum of a stored header, if the file is long enough.
fn reseal_header(bytes: &mut [u8]) {
    let Some(length) = bytes.first_chunk().map(|length| usize::from(u16::from_le_bytes(*length))) else {
        return;
    };
    if let Some((content, checksum)) = bytes.get_mut(2..2 + length).and_then(<[u8]>::split_last_chunk_mut) {
        *checksum = crc32fast::hash(content).to_le_bytes();
    }
}

#[test]
fn stored_models_are_read_or_refused() {
    let folder = folder();
    let (store, _) = ModelStore::open(folder.path()).unwrap();
    let key = ModelKey { device: DeviceId::new("drone-7").unwrap(), model: ModelId(3) };
    let path = folder.path().join("drone-7.3.model");
    let samples = [1, 40].map(|count| {
        let splats = random_splats(1, count, 1);
        let Offer { header, body } =
            Offer::new(key.device, key.model, ModelKind::Local, 9, &splats, &cameras(1)).unwrap();
        store.put(&header, &body).unwrap();
        fs::read(&path).unwrap()
    });
    hammer(target("stored models", samples.into(), reseal_header), |bytes| {
        fs::write(&path, bytes).unwrap();
        store.get(key).is_ok()
    });
}

/// Recomputes the checksum of the first entry of a recording, if it is complete.
fn reseal_entry(bytes: &mut [u8]) {
    let Some(head) = bytes.get(8..19).and_then(<[u8]>::first_chunk::<11>) else { return };
    let [.., a, b, c, d, e, f] = *head;
    let end = 19 + usize::from(u16::from_le_bytes([a, b])) + u32::from_le_bytes([c, d, e, f]) as usize;
    if let Some(entry) = bytes.get_mut(8..end.saturating_add(4))
        && let Some((content, checksum)) = entry.split_last_chunk_mut()
    {
        *checksum = crc32fast::hash(content).to_le_bytes();
    }
}

#[test]
fn recordings_are_read_or_refused() {
    let mut bytes = Vec::new();
    let mut recorder = Recorder::new(&mut bytes).unwrap();
    for i in 0..3u8 {
        let (at, topic) = (Duration::from_secs(i.into()), "gs/v1/quarry/drone-1/state".to_owned());
        recorder.add(&Entry { at, topic, qos: 1, retain: i == 1, payload: vec![i; 40] }).unwrap();
    }
    hammer(target("recordings", vec![bytes], reseal_entry), |bytes| {
        let Ok(mut recording) = Recording::open(bytes) else { return false };
        let mut entries = 0;
        while let Ok(Some(_)) = recording.next_entry() {
            entries += 1;
        }
        entries > 0
    });
}

#[test]
fn lists_of_keys_are_read_or_refused() {
    let line = |name: &str| key_of(name).public_line(&DeviceId::new(name).unwrap());
    let text = format!("# keys\n{}\nrevoked {}\n", line("drone-1"), line("drone-2"));
    hammer(target("lists of keys", vec![text.into_bytes()], |_| ()), |bytes| {
        std::str::from_utf8(bytes).is_ok_and(|text| Trusted::parse(text).is_ok())
    });
}

#[test]
fn settings_of_agents_are_read_or_refused() {
    let text = "device = \"drone-1\"\nsite = \"quarry\"\nbroker = \"mqtts://host:8883\"\ndata = \"a\"\nout = \"b\"\nsteps = 7\n";
    hammer(target("agent.toml", vec![text.as_bytes().to_vec()], |_| ()), |bytes| {
        std::str::from_utf8(bytes).is_ok_and(|text| AgentConfig::from_toml(text).is_ok())
    });
}

#[test]
fn settings_of_aggregators_are_read_or_refused() {
    let text = "site = \"quarry\"\nout = \"b\"\nbind = \"127.0.0.1:1883\"\nquorum = 2\nquiet_s = 5\n";
    hammer(target("aggregator.toml", vec![text.as_bytes().to_vec()], |_| ()), |bytes| {
        std::str::from_utf8(bytes).is_ok_and(|text| parse_toml::<AggregatorConfig>(text).is_ok())
    });
}

#[test]
fn lists_of_users_are_read_or_refused() {
    let line = |name: &str| user_line(&DeviceId::new(name).unwrap(), "secret", [7; 16]).unwrap();
    let text = format!("# users\n{}\n\n{}\n", line("drone-1"), line("drone-2"));
    let folder = folder();
    let path = folder.path().join("users.txt");
    hammer(target("lists of users", vec![text.into_bytes()], |_| ()), |bytes| {
        fs::write(&path, bytes).unwrap();
        Users::read(&path).is_ok()
    });
}

#[test]
fn heads_of_checkpoints_are_read_or_refused() {
    let head = "{\"format\":\"cosurf checkpoint 5\",\"fingerprint\":\"ab12\",\"steps\":9,\"steps_done\":7,\"splats\":3,\
                \"splats_at_start\":3,\"seconds\":1.5,\"cpu_seconds\":2.5}\n";
    let folder = folder();
    let path = checkpoint::path(folder.path());
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let sample = [head.as_bytes(), &[7; 40]].concat();
    hammer(target("checkpoints", vec![sample], |_| ()), |bytes| {
        fs::write(&path, bytes).unwrap();
        matches!(Checkpoint::find(folder.path()), Ok(Some(_)))
    });
}
