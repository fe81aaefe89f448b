//! A service whose tiles are distilled by a worker.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use cosurf_engine::{Device, DeviceChoice};
use cosurf_tests::nats::Nats;

use super::*;
use crate::queue::Queue;
use crate::store::Store;
use crate::testing::{above, ground};
use crate::worker::{WorkerEvent, WorkerSettings, work};

/// Two drones whose models share ground.
fn neighbours(network: &MemoryNetwork) -> Vec<Drone> {
    [("agent-1", -3.0), ("agent-2", -1.0)]
        .map(|(name, west)| {
            let model =
                Model { splats: ground(west, west + 4.0), cameras: vec![above(f64::from(west) + 2.0)] };
            Drone::new(network, name, 1, &model)
        })
        .into()
}

/// One flight of both. Returns the bytes of the global model.
fn fly(folder: &Path, employ: impl FnOnce(Service) -> Service) -> Vec<u8> {
    let network = MemoryNetwork::new(1, BAD_WEATHER);
    let merge =
        MergeSettings { vouched: true, epochs: 2, device: DeviceChoice::Cpu, ..MergeSettings::default() };
    let Ground { service, transport } = open_with(&network, folder, fleet(&["agent-1", "agent-2"]), merge);
    let mut ground = Ground { service: employ(service), transport };
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(&network, &mut ground, &mut neighbours(&network), delivered);
    fs::read(global_ply(folder)).unwrap()
}

#[test]
fn a_worker_distils_the_tiles_of_a_service_and_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let Some(nats) = Nats::start(&path("nats")) else { return };
    let alone = fly(&path("alone"), |service| service);
    let store = Store::in_folder(&path("store")).unwrap();
    let settings = WorkerSettings {
        device: Device::Cpu,
        threads: 1,
        memory_bytes: 1 << 30,
        scratch: folder.path().to_owned(),
    };
    let is_over = AtomicBool::new(false);
    let (by_worker, distilled) = thread::scope(|scope| {
        let worker = scope.spawn(|| {
            let mut distilled = 0;
            work(
                &Queue::open(&nats.url()).unwrap(),
                &store,
                &settings,
                &|| is_over.load(Ordering::Relaxed),
                &mut |event| distilled += usize::from(matches!(event, WorkerEvent::Distilled { .. })),
            );
            distilled
        });
        let queue = Queue::open(&nats.url()).unwrap();
        let bytes = fly(&path("by"), |service| service.with_workers(store.folder("test.station"), queue));
        is_over.store(true, Ordering::Relaxed);
        (bytes, worker.join().unwrap())
    });
    assert!(by_worker == alone);
    assert!(distilled > 0);
    let left = fs::read_dir(path("store/test.station")).unwrap().count();
    assert_eq!(left, distilled, "the results are kept");
}
