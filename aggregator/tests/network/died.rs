//! A program that dies in merges, killed from outside while it reads a certain model.

use std::fs;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_link::ModelStore;
use cosurf_tests::offers::mergeable_offer;

use crate::ground::Ground;
use crate::station::loopback;

const PATIENCE: Duration = Duration::from_secs(120);

/// Waits until the merge reads the model with this index, and kills the program.
fn die_as_it_reads(folder: &Path, index: u32) {
    let mut ground = Ground::spawn(folder, loopback());
    // Only then is the note of an earlier merge gone.
    ground.lines_until("connected to the broker");
    let begun = Instant::now();
    while fs::read(folder.join("out/reading")).ok().is_none_or(|bytes| bytes != index.to_le_bytes()) {
        assert!(begun.elapsed() < PATIENCE, "the merge does not read model {index}");
        sleep(Duration::from_micros(100));
    }
    ground.kill();
    assert!(folder.join("out/reading").exists(), "the merge ended before it was killed");
}

#[test]
fn attack_01_a_model_that_kills_every_merge_is_set_aside() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = ModelStore::open(&folder.path().join("out/models")).unwrap();
    for (i, device) in ["drone-1", "drone-2", "drone-3"].into_iter().enumerate() {
        let offer = mergeable_offer(device, 20_000 + i);
        store.put(&offer.header, &offer.body).unwrap();
    }
    let config = format!(
        "site = \"site\"\nout = \"{}\"\nbind = \"127.0.0.1:0\"\nquiet_s = 1\nquorum = 1\n",
        folder.path().join("out").display()
    );
    fs::write(folder.path().join("aggregator.toml"), config).unwrap();
    // Each time it may have been a power cut: the model is merged again.
    (0..5).for_each(|_| die_as_it_reads(folder.path(), 1));
    let mut ground = Ground::spawn(folder.path(), loopback());
    let lines = ground.lines_until("global model, revision");
    let told = lines.iter().find(|line| line.contains("set aside")).expect("a line tells it");
    assert!(told.contains("model 1 of drone-2") && told.contains("suspects.json"), "{told}");
    assert!(lines.last().unwrap().contains("2 models"), "{lines:?}");
    ground.kill();
    // The remedy.
    fs::remove_file(folder.path().join("out/suspects.json")).unwrap();
    let mut ground = Ground::spawn(folder.path(), loopback());
    let lines = ground.lines_until("global model, revision");
    assert!(lines.last().unwrap().contains("3 models"), "{lines:?}");
}
