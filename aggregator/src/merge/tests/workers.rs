//! Merges by workers while somebody else can reach the queue or the store. The result has the bytes of a merge without
//! workers.

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use cosurf_tests::nats::Nats;

use super::*;
use crate::merge::results;
use crate::queue::{Delivered, Queue};
use crate::worker::{WorkerEvent, WorkerSettings, work};

/// Largest number of splats of a tile.
const TILE_SPLATS: usize = 400;
/// Workers that give no result for so long are absent.
const SHORT: Duration = Duration::from_millis(300);

/// A merge that takes longer does not end by itself.
const MERGE_MAX: Duration = Duration::from_secs(50);

fn settings() -> MergeSettings {
    MergeSettings { epochs: 2, device: DeviceChoice::Cpu, ..MergeSettings::default() }
}

/// A merge by workers beside something else, which runs until the merge has ended. Returns the merged model and the
/// lines about trouble.
fn beside(
    patience: Duration,
    other: impl FnOnce(&Queue, &Store, &Path, &dyn Fn() -> bool) + Send,
) -> Option<(Merged, Vec<String>)> {
    let folder = tempfile::tempdir().unwrap();
    let nats = Nats::start(&folder.path().join("nats"))?;
    let [store, others] = [(); 2].map(|()| Store::in_folder(&folder.path().join("store")).unwrap());
    let [queue, its] = [(); 2].map(|()| Queue::open(&nats.url()).unwrap());
    let (is_over, scratch) = (AtomicBool::new(false), folder.path().join("scratch"));
    let (say, troubles) = mpsc::channel();
    let merged = thread::scope(|scope| {
        scope.spawn(|| other(&its, &others, folder.path(), &|| is_over.load(Ordering::Relaxed)));
        let workers = Workers { store: &store, queue: &queue, patience, say: &say };
        let resources = Resources { scratch: &scratch, tiles: Tiles::ByWorkers(workers), threads: 1 };
        let begun = Instant::now();
        let mut go_on = |_: MergeProgress| match begun.elapsed() < MERGE_MAX {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(()),
        };
        let merged = merge_in_tiles(&neighbours(), &settings(), resources, TILE_SPLATS, &mut go_on);
        is_over.store(true, Ordering::Relaxed);
        merged.and_then(MergedFile::read)
    });
    Some((merged.unwrap(), troubles.try_iter().collect()))
}

/// Works like any worker until the merge has ended. Returns the number of tiles.
fn work_until(queue: &Queue, store: &Store, folder: &Path, is_over: &dyn Fn() -> bool) -> usize {
    let settings =
        WorkerSettings { device: Device::Cpu, threads: 1, memory_bytes: 1 << 30, scratch: folder.to_owned() };
    let mut distilled = 0;
    work(queue, store, &settings, is_over, &mut |event| {
        distilled += usize::from(matches!(event, WorkerEvent::Distilled { .. }));
    });
    distilled
}

/// The same merge without workers.
fn alone() -> Merged {
    in_tiles(&neighbours(), &settings(), 1, TILE_SPLATS)
}

/// Writes splats as the result of each task that has none; at most `times` in all.
fn poison(store: &Store, folder: &Path, splats: &Splats, times: usize, is_over: &dyn Fn() -> bool) {
    let mut left = times;
    while left > 0 && !is_over() {
        let names = fs::read_dir(folder.join("store")).unwrap();
        let names: Vec<String> =
            names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        for task in names.iter().filter_map(|name| name.strip_suffix(".task")) {
            if left > 0 && !names.iter().any(|name| name == task) {
                results::keep(store, &blake3::Hash::from_hex(task).unwrap(), splats).unwrap();
                left -= 1;
            }
        }
        thread::sleep(Duration::from_millis(5));
    }
}

/// Splats that no drone has sent.
fn false_splats() -> [Splats; 2] {
    let nowhere = ground(500.0, 503.0);
    let mut endless = ground(-1.0, 1.0);
    endless.means[0][0] = f32::NAN;
    [nowhere, endless]
}

#[test]
fn this_computer_distils_a_tile_after_two_bad_results() {
    let alone = alone();
    for splats in false_splats() {
        let poisoner = |_: &Queue, store: &Store, folder: &Path, is_over: &dyn Fn() -> bool| {
            poison(store, folder, &splats, usize::MAX, is_over);
        };
        let Some((merged, troubles)) = beside(Workers::PATIENCE, poisoner) else { return };
        assert!(merged == alone, "the merge has other bytes");
        let told = |what: &str| troubles.iter().filter(|trouble| trouble.contains(what)).count();
        let tiles = alone.summary.tiles;
        assert_eq!([told("a worker distils it again"), told("this computer distils it")], [tiles; 2]);
        let first = &alone.tiles[0].task[..12];
        assert_eq!(told(first), 2, "each trouble is told once, with the tile: {troubles:?}");
    }
}

#[test]
fn a_worker_distils_a_tile_again_after_one_bad_result() {
    let (alone, mut distilled) = (alone(), 0);
    let [splats, _] = false_splats();
    let other = |queue: &Queue, store: &Store, folder: &Path, is_over: &dyn Fn() -> bool| {
        poison(store, folder, &splats, 1, is_over);
        distilled = work_until(queue, store, folder, is_over);
    };
    let Some((merged, troubles)) = beside(Workers::PATIENCE, other) else { return };
    assert!(merged == alone, "the merge has other bytes");
    assert_eq!((troubles.len(), distilled), (1, alone.summary.tiles), "{troubles:?}");
}

#[test]
fn a_client_that_holds_all_tasks_for_ever_does_not_stop_a_merge() {
    let thief = |queue: &Queue, _: &Store, _: &Path, is_over: &dyn Fn() -> bool| {
        let mut held: Vec<Delivered> = Vec::new();
        while !is_over() {
            held.extend(queue.take(&Device::Cpu.class()).unwrap());
        }
        assert!(!held.is_empty());
    };
    ends_without_workers(thief);
}

#[test]
fn a_client_that_removes_all_tasks_from_the_queue_does_not_stop_a_merge() {
    let thief = |queue: &Queue, _: &Store, _: &Path, is_over: &dyn Fn() -> bool| {
        let mut removed = 0;
        while !is_over() {
            if let Some(delivered) = queue.take(&Device::Cpu.class()).unwrap() {
                delivered.finish().unwrap();
                removed += 1;
            }
        }
        assert!(removed > 0);
    };
    ends_without_workers(thief);
}

fn ends_without_workers(thief: impl FnOnce(&Queue, &Store, &Path, &dyn Fn() -> bool) + Send) {
    let Some((merged, troubles)) = beside(SHORT, thief) else { return };
    assert!(merged == alone(), "the merge has other bytes");
    let told = "the workers have not distilled a tile for 0 s; this computer distils tiles too";
    assert_eq!(troubles, [told], "it is told once");
}
