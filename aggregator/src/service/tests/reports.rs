//! Reports are made while nothing is merged, once for each revision.

use std::fs;
use std::sync::atomic::{AtomicUsize, Ordering};

use cosurf_wire::SiteId;

use super::super::record::Merging;
use super::super::reporting::{ReportError, ReportTask, Reported, Reporter};
use super::*;

/// A service that makes reports, its network and its folder.
fn reporting(seed: u64, reporter: Reporter) -> (MemoryNetwork, tempfile::TempDir, Ground) {
    let (network, folder) = (MemoryNetwork::new(seed, Faults::NONE), tempfile::tempdir().unwrap());
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let task = ReportTask::new(folder.path().to_path_buf(), SiteId::new("test").unwrap(), 1 << 30, 1);
    ground.service = ground.service.with_reports(reporter, task);
    (network, folder, ground)
}

/// Lets the thread of a report work: the time of the service does not wait for it.
fn let_work() {
    std::thread::sleep(Duration::from_micros(500));
}

fn is_reported(event: &ServiceEvent) -> bool {
    matches!(event, ServiceEvent::Reported { .. })
}

/// Writes the three files.
fn write(task: &ReportTask) -> Result<Reported, ReportError> {
    let revision = Merging::read(&task.folder).ok_or(ReportError::Stopped)?.revision;
    for name in ["mesh.ply", "report.html", "report.json"] {
        fs::write(task.folder.join(name), revision.to_string()).unwrap();
    }
    Ok(Reported { revision, triangles: Some(1), mesh_failure: None, is_new: true })
}

/// A report that takes as long as it may.
fn linger(task: &ReportTask) -> Result<Reported, ReportError> {
    static CALLS: AtomicUsize = AtomicUsize::new(0);
    if CALLS.fetch_add(1, Ordering::Relaxed) > 0 {
        return write(task);
    }
    while !task.is_stopped() {
        std::thread::yield_now();
    }
    Err(ReportError::Stopped)
}

fn fail(_: &ReportTask) -> Result<Reported, ReportError> {
    panic!("on purpose")
}

#[test]
fn each_revision_gets_one_report_which_goes_with_the_model() {
    let (network, folder, mut ground) = reporting(1, write);
    let mut drones = drones(&network, 2);
    let enough = |events: &[ServiceEvent], drones: &[Drone]| {
        let_work();
        let newest = events.iter().rev().find(|event| is_reported(event));
        let revision = drones.iter().filter_map(|drone| drone.global).map(|global| global.model.0).max();
        count(events, is_stored) == 2
            && matches!(newest, Some(ServiceEvent::Reported { revision: of, .. }) if Some(*of) == revision)
            && drones.iter().all(|drone| drone.global.map(|global| global.model.0) == revision)
    };
    let events = simulate(&network, &mut ground, &mut drones, enough);
    let (merges, reports) = (count(&events, is_merged), count(&events, is_reported));
    assert!((1..=merges).contains(&reports), "{events:?}");
    let until = network.now() + Duration::from_secs(2);
    let mut more = Vec::new();
    while network.now() < until {
        step(&network, &mut ground, &mut drones, &mut more);
    }
    assert_eq!(count(&more, is_reported), 0, "no report is made twice: {more:?}");
    for device in ["agent-1", "agent-2"] {
        super::super::withdraw(folder.path(), &DeviceId::new(device).unwrap()).unwrap();
    }
    let is_gone = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::GlobalWithdrawn);
    simulate(&network, &mut ground, &mut drones, is_gone);
    for name in ["global.ply", "mesh.ply", "report.html", "report.json"] {
        assert!(!folder.path().join(name).exists(), "{name} shows withdrawn ground");
    }
}

#[test]
fn a_merge_that_is_due_ends_a_report() {
    let (network, _folder, mut ground) = reporting(2, linger);
    let mut fleet = drones(&network, 1);
    let merged = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(&network, &mut ground, &mut fleet, merged);
    fleet.push(Drone::new(&network, "agent-2", 1, &model(700, 0, 2.0)));
    let reported = |events: &[ServiceEvent], _: &[Drone]| {
        let_work();
        count(events, is_reported) > 0
    };
    let events = simulate(&network, &mut ground, &mut fleet, reported);
    assert_eq!(count(&events, is_merged), 1, "{events:?}");
    let told = events.iter().find(|event| is_reported(event));
    assert!(matches!(told, Some(ServiceEvent::Reported { revision: 2, .. })), "{events:?}");
}

#[test]
fn a_report_that_fails_is_told_and_the_service_goes_on() {
    let (network, _folder, mut ground) = reporting(3, fail);
    let mut fleet = drones(&network, 1);
    let failed = |events: &[ServiceEvent], _: &[Drone]| {
        let_work();
        count(events, is_disk_failure) > 0
    };
    let events = simulate(&network, &mut ground, &mut fleet, failed);
    let told = events.iter().find(|event| is_disk_failure(event)).unwrap().to_string();
    assert!(told.contains("no report of revision 1") && told.contains("internal error"), "{told}");
    fleet.push(Drone::new(&network, "agent-2", 1, &model(700, 0, 2.0)));
    let merged = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(&network, &mut ground, &mut fleet, merged);
}
