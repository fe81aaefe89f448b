//! The board: what the ground station knows of a running site. Services, missions and agents' statuses write on it; pages
//! and scripts read it.
//!
//! What it knows nothing about: HTTP, and how models are merged. Everything on it is bounded: devices, lines, and the
//! length of texts. A reader is told only that the board has changed, so a slow one keeps nothing waiting: it reads all that
//! has changed since it last read, each device once.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use cosurf_contract::{AgentPhase, AgentStatus, Curve, Escaped};
use cosurf_link::ModelStore;
use cosurf_wire::DeviceId;
use tokio::sync::watch;

use super::state::{DeviceState, Line, Revision, State};
use crate::colors::device_css;
use crate::merge::MergeProgress;
use crate::service::{DeviceStatus, KeptOut, Merging, ServiceEvent, revoked, senders, withdrawn};

/// Largest number of devices; further ones have no row.
const DEVICES_MAX: usize = 1024;
/// A device of which nothing is known gets a row up to this number of devices: at a broker that lets everybody write, invented
/// names must leave rows for devices that the site expects, or that send models.
const TOLD_DEVICES_MAX: usize = 768;
/// A device of which nothing is known loses its row to another one once it was not heard for so long, seconds.
const STALE_S: f64 = 300.0;
/// Largest number of lines of the log; the oldest ones go.
const LINES_MAX: usize = 300;
/// Longest text of a line, characters.
const LINE_CHARS_MAX: usize = 400;
/// Largest number of points of a training curve that are shown: as many as a small chart has pixels for.
const CURVE_POINTS_MAX: usize = 32;

/// A board. Clones share it.
#[derive(Clone, Debug)]
pub struct Board(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    folder: PathBuf,
    begun: Instant,
    state: Mutex<Notes>,
    /// The number of the newest change.
    changes: watch::Sender<u64>,
}

/// What is on the board.
#[derive(Clone, Debug, Default)]
struct Notes {
    is_connected: bool,
    merge: Option<MergeProgress>,
    revision: Option<Revision>,
    devices: BTreeMap<DeviceId, Device>,
    /// Devices that the site expects.
    expected: BTreeSet<DeviceId>,
    /// The change that last removed a device: readers that know older ones need all devices.
    removed: u64,
    /// Lines with the number of the change that wrote them.
    log: VecDeque<(u64, Line)>,
    events: u64,
    /// Number of changes so far.
    change: u64,
}

#[derive(Clone, Debug, Default)]
struct Device {
    status: Option<AgentStatus>,
    /// Curve of the training since the program began.
    curve: Curve,
    /// When it was last heard, seconds since the board was made; below 0 if that was before.
    heard_s: Option<f64>,
    model: Option<u64>,
    uploads: u64,
    kept_out: Option<String>,
    is_revoked: bool,
    /// True if its models were withdrawn, and none has arrived since.
    is_withdrawn: bool,
    /// The number of its newest change.
    changed: u64,
}

impl Board {
    /// The board of the service or mission with this folder. Models and a revision that are there already are on it.
    pub fn new(folder: &Path) -> Self {
        let mut notes = Notes { change: 1, ..Notes::default() };
        for key in ModelStore::beside(&folder.join("models")).keys().unwrap_or_default() {
            if let Some(known) = notes.device(key.device, DEVICES_MAX) {
                known.model = known.model.max(Some(key.model.0));
            }
        }
        if let Some(merging) = Merging::read(folder) {
            notes.keep_out(&merging.kept_out);
            notes.revision = Some(Revision {
                revision: merging.revision,
                splats: merging.summary.splats,
                models: merging.inputs.len() - merging.kept_out.len(),
                restored_from: merging.restored_from,
                is_reported: folder.join("report.html").is_file(),
            });
        }
        for device in revoked(folder).unwrap_or_default() {
            notes.revoke(device, true);
        }
        for device in withdrawn(folder).unwrap_or_default() {
            if let Some(its) = notes.device(device, DEVICES_MAX) {
                its.is_withdrawn = its.model.is_none();
            }
        }
        let state = Mutex::new(notes);
        let (changes, _) = watch::channel(1);
        Self(Arc::new(Shared { folder: folder.into(), begun: Instant::now(), state, changes }))
    }

    /// Names devices that the site expects. They take rows of devices of which nothing is known.
    pub fn expect(&self, devices: BTreeSet<DeviceId>) {
        self.change(|notes, _| notes.expected = devices);
    }

    /// Notes an event of the service.
    pub fn note_service(&self, event: &ServiceEvent) {
        self.change(|notes, now_s| {
            notes.events += 1;
            notes.follow(event);
            if !matches!(event, ServiceEvent::Merging(_)) {
                notes.write(now_s, &Escaped(event).to_string());
            }
        });
    }

    /// Notes how far an agent is, as it tells now.
    pub fn note_status(&self, device: DeviceId, status: AgentStatus) {
        self.note_status_of(device, status, 0.0);
    }

    /// Notes how far a device is, as it has told through the broker. A status that the broker has kept is as old as the
    /// time in it.
    pub fn note_heard(&self, DeviceStatus { device, status, is_kept }: &DeviceStatus) {
        let clock_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let age_s = if *is_kept { clock_s.saturating_sub(status.time_s) } else { 0 };
        self.note_status_of(*device, status.clone(), age_s as f64);
    }

    fn note_status_of(&self, device: DeviceId, status: AgentStatus, age_s: f64) {
        self.change(|notes, now_s| {
            let Some(known) = notes.told_device(device, now_s) else { return };
            if known.is_revoked {
                return;
            }
            if let (AgentPhase::Training, Some(psnr)) = (status.phase, status.psnr) {
                known.curve.push(status.step, psnr);
            }
            (known.status, known.heard_s) = (Some(status), Some(now_s - age_s));
        });
    }

    /// Writes a line into the log.
    pub fn note_line(&self, text: &str) {
        self.change(|notes, now_s| notes.write(now_s, &Escaped(text).to_string()));
    }

    /// The folder of the service or mission.
    pub(super) fn folder(&self) -> &Path {
        &self.0.folder
    }

    /// The newest revision.
    pub(super) fn revision(&self) -> Option<u64> {
        self.notes().revision.as_ref().map(|revision| revision.revision)
    }

    /// Tells of changes from now on.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.0.changes.subscribe()
    }

    /// The devices with a stored model, by name, each with the number of its newest one.
    pub(super) fn models(&self) -> Vec<(DeviceId, u64)> {
        self.notes().devices.iter().filter_map(|(device, its)| Some((*device, its.model?))).collect()
    }

    /// Whether the site knows a device: it was heard, it is expected, or a model of it is stored.
    pub(super) fn knows(&self, device: &DeviceId) -> bool {
        let notes = self.notes();
        let has_row = notes.devices.contains_key(device) || notes.expected.contains(device);
        drop(notes);
        // A device may have models but no row.
        has_row || senders(self.folder()).is_ok_and(|senders| senders.contains(device))
    }

    /// The state of the site.
    pub(super) fn state(&self) -> State {
        self.state_since(0).0
    }

    /// What has changed since the change with this number, 0 for everything; and the number of the newest change.
    pub(super) fn state_since(&self, seen: u64) -> (State, u64) {
        let (now_s, notes) = (self.now_s(), self.notes());
        let seen = if seen < notes.removed { 0 } else { seen };
        let is_new = |change: u64| seen == 0 || change > seen;
        let devices = notes.devices.iter().filter(|(_, its)| is_new(its.changed));
        let log = notes.log.iter().filter(|(change, _)| is_new(*change));
        let state = State {
            is_whole: seen == 0,
            uptime_s: now_s,
            is_connected: notes.is_connected,
            merge: notes.merge,
            revision: notes.revision.clone(),
            devices: devices.map(|(device, its)| its.state(device, now_s)).collect(),
            log: log.map(|(_, line)| line.clone()).collect(),
            events: notes.events,
        };
        (state, notes.change)
    }

    /// Changes what is on the board, and tells the readers.
    fn change(&self, what: impl FnOnce(&mut Notes, f64)) {
        let mut notes = self.notes();
        notes.change += 1;
        what(&mut notes, self.now_s());
        let change = notes.change;
        drop(notes);
        self.0.changes.send_modify(|newest| *newest = change.max(*newest));
    }

    fn notes(&self) -> MutexGuard<'_, Notes> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now_s(&self) -> f64 {
        self.0.begun.elapsed().as_secs_f64()
    }
}

impl Device {
    fn state(&self, device: &DeviceId, now_s: f64) -> DeviceState {
        let points = self.curve.points();
        let count = points.len().min(CURVE_POINTS_MAX);
        let spaced = (0..count).map(|i| points[i * (points.len() - 1) / (count - 1).max(1)]);
        // Two decimals are more than a chart shows.
        let short = |v: f32| (f64::from(v) * 100.0).round() / 100.0;
        DeviceState {
            device: device.to_string(),
            color: device_css(device.as_str()),
            heard_s_ago: self.heard_s.map(|heard_s| now_s - heard_s),
            status: self.status.clone(),
            curve: spaced.map(|point| point.map(short)).collect(),
            model: self.model,
            uploads: self.uploads,
            is_revoked: self.is_revoked,
            is_withdrawn: self.is_withdrawn,
            kept_out: self.kept_out.clone(),
        }
    }
}

impl Notes {
    /// The row of a device that changes; `None` if it has none and there are `most` already.
    fn device(&mut self, device: DeviceId, most: usize) -> Option<&mut Device> {
        if self.devices.len() >= most && !self.devices.contains_key(&device) {
            return None;
        }
        let its = self.devices.entry(device).or_default();
        its.changed = self.change;
        Some(its)
    }

    /// The row of a device that tells how far it is. If all rows are taken, an expected device gets that of the unknown one
    /// that was not heard for longest, and another device only one that is stale.
    fn told_device(&mut self, device: DeviceId, now_s: f64) -> Option<&mut Device> {
        if self.devices.len() >= TOLD_DEVICES_MAX && !self.devices.contains_key(&device) {
            let is_expected = self.expected.contains(&device);
            let unknown = self.devices.iter().filter(|(name, its)| {
                its.model.is_none() && !its.is_revoked && !self.expected.contains(*name)
            });
            let heard_s = |its: &Device| its.heard_s.unwrap_or(f64::NEG_INFINITY);
            let stalest = unknown.min_by(|(_, one), (_, other)| heard_s(one).total_cmp(&heard_s(other)));
            let (name, its) = stalest?;
            if !is_expected && now_s - heard_s(its) < STALE_S {
                return None;
            }
            let name = *name;
            self.devices.remove(&name);
            self.removed = self.change;
        }
        self.device(device, DEVICES_MAX)
    }

    fn follow(&mut self, event: &ServiceEvent) {
        match event {
            ServiceEvent::Connected => self.is_connected = true,
            ServiceEvent::Disconnected { .. } => self.is_connected = false,
            ServiceEvent::Stored { header } => {
                if let Some(device) = self.device(header.device, DEVICES_MAX) {
                    (device.model, device.uploads) = (Some(header.model.0), device.uploads + 1);
                    device.is_withdrawn = false;
                }
            }
            ServiceEvent::Merging(progress) => self.merge = Some(*progress),
            ServiceEvent::Merged { header, models, kept_out } => {
                self.keep_out(kept_out);
                let (revision, splats) = (header.model.0, header.splats as usize);
                let models = *models;
                // Models that were merged before give the same revision, whose report stays.
                let is_reported =
                    self.revision.as_ref().is_some_and(|its| its.revision == revision && its.is_reported);
                self.revision = Some(Revision { revision, splats, models, restored_from: None, is_reported });
            }
            ServiceEvent::NothingMerged { kept_out } => self.keep_out(kept_out),
            ServiceEvent::Reported { revision, .. } => {
                let newest = self.revision.as_mut().filter(|newest| newest.revision == *revision);
                newest.into_iter().for_each(|newest| newest.is_reported = true);
            }
            ServiceEvent::Withdrawn { device } => {
                if let Some(its) = self.devices.get_mut(device) {
                    (its.model, its.kept_out, its.is_withdrawn) = (None, None, true);
                    its.changed = self.change;
                }
            }
            ServiceEvent::Revoked { device } => self.revoke(*device, true),
            ServiceEvent::Readmitted { device } => self.revoke(*device, false),
            ServiceEvent::Restored { revision, from } => {
                let newest = self.revision.as_mut().filter(|newest| newest.revision == *revision);
                newest.into_iter().for_each(|newest| newest.restored_from = Some(*from));
            }
            ServiceEvent::GlobalWithdrawn => self.revision = None,
            _ => {}
        }
    }

    fn revoke(&mut self, device: DeviceId, is_revoked: bool) {
        if let Some(its) = self.device(device, DEVICES_MAX) {
            its.is_revoked = is_revoked;
        }
    }

    /// Notes which models a merge that has ended kept out.
    fn keep_out(&mut self, kept_out: &[KeptOut]) {
        self.merge = None;
        for (device, its) in &mut self.devices {
            let its_own = kept_out.iter().find(|kept_out| kept_out.device == device.as_str());
            let reason = its_own.map(|kept_out| kept_out.reason.clone());
            if reason != its.kept_out {
                (its.kept_out, its.changed) = (reason, self.change);
            }
        }
    }

    fn write(&mut self, at_s: f64, text: &str) {
        if self.log.len() >= LINES_MAX {
            self.log.pop_front();
        }
        let line = Line { at_s, text: text.chars().take(LINE_CHARS_MAX).collect() };
        self.log.push_back((self.change, line));
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::service::withdraw;

    fn device(name: &str) -> DeviceId {
        DeviceId::new(name).unwrap()
    }

    fn board() -> Board {
        Board::new(Path::new("no such folder"))
    }

    #[test]
    fn a_withdrawn_device_is_shown_as_one_until_its_next_model() {
        let folder = tempfile::tempdir().unwrap();
        let is_withdrawn = |board: &Board| {
            let devices = board.state().devices;
            devices.iter().find(|its| its.device == "a").is_some_and(|its| its.is_withdrawn)
        };
        let board = Board::new(folder.path());
        board.note_status(device("a"), AgentStatus::new(300, "1"));
        assert!(!is_withdrawn(&board));
        withdraw(folder.path(), &device("a")).unwrap();
        board.note_service(&ServiceEvent::Withdrawn { device: device("a") });
        assert!(is_withdrawn(&board) && is_withdrawn(&Board::new(folder.path())), "over a restart, too");
        let offer = cosurf_tests::offers::mergeable_offer("a", 50);
        board.note_service(&ServiceEvent::Stored { header: offer.header });
        assert!(!is_withdrawn(&board));
        let (models, _) = ModelStore::open(&folder.path().join("models")).unwrap();
        models.put(&offer.header, &offer.body).unwrap();
        assert!(!is_withdrawn(&Board::new(folder.path())));
    }

    #[test]
    fn the_board_shows_who_is_kept_out_until_the_next_merge() {
        let board = board();
        board.note_status(device("a"), AgentStatus::new(300, "1"));
        board.note_status(device("b"), AgentStatus::new(300, "1"));
        let kept_out = KeptOut { device: "b".into(), model: 1, reason: "contradicts a".into() };
        board.note_service(&ServiceEvent::Merging(MergeProgress { step: 1, steps: 9, psnr: Some(20.0) }));
        assert_eq!(board.state().merge.unwrap().steps, 9);
        board.note_service(&ServiceEvent::NothingMerged { kept_out: vec![kept_out] });
        let state = board.state();
        let reasons: Vec<Option<&str>> = state.devices.iter().map(|its| its.kept_out.as_deref()).collect();
        assert_eq!((reasons, state.merge), (vec![None, Some("contradicts a")], None));
        board.note_service(&ServiceEvent::NothingMerged { kept_out: Vec::new() });
        assert!(board.state().devices.iter().all(|its| its.kept_out.is_none()));
    }

    #[test]
    fn a_revision_that_is_merged_again_keeps_its_report() {
        let board = board();
        let mut header = cosurf_tests::offers::mergeable_offer("ground", 50).header;
        let mut is_reported_after = |revision: u64| {
            header.model = cosurf_wire::ModelId(revision);
            board.note_service(&ServiceEvent::Merged { header, models: 1, kept_out: Vec::new() });
            board.state().revision.unwrap().is_reported
        };
        assert!(!is_reported_after(7));
        board.note_service(&ServiceEvent::Reported { revision: 7, triangles: None, mesh_failure: None });
        assert!(is_reported_after(7), "nothing has changed");
        assert!(!is_reported_after(8));
    }

    #[test]
    fn devices_lines_and_texts_are_bounded() {
        let board = board();
        for i in 0..DEVICES_MAX + 10 {
            board.note_status(device(&format!("d-{i}")), AgentStatus::new(1, "1"));
            board.note_line(&"x".repeat(LINE_CHARS_MAX + 7));
        }
        let state = board.state();
        assert_eq!((state.devices.len(), state.log.len()), (TOLD_DEVICES_MAX, LINES_MAX));
        assert!(state.log.iter().all(|line| line.text.len() == LINE_CHARS_MAX));
    }

    #[test]
    fn invented_names_leave_rows_for_expected_devices_and_those_that_send_models() {
        let board = board();
        let expected = ["drone-1", "drone-2"].map(device);
        board.expect(expected.into());
        for i in 0..2 * DEVICES_MAX {
            board.note_status(device(&format!("d-{i}")), AgentStatus::new(1, "1"));
        }
        let (_, seen) = board.state_since(0);
        expected.iter().for_each(|name| board.note_status(*name, AgentStatus::new(9, "1")));
        board.note_status(device("stranger"), AgentStatus::new(9, "1"));
        let (state, _) = board.state_since(seen);
        let has = |name: &str| state.devices.iter().any(|its| its.device == name);
        assert!(state.is_whole, "readers learn that rows are gone");
        assert_eq!(state.devices.len(), TOLD_DEVICES_MAX);
        assert!(has("drone-1") && has("drone-2") && !has("stranger") && !has("d-0"));
    }

    #[test]
    fn a_reader_that_was_slow_is_told_once() {
        let board = board();
        let mut changes = board.changes();
        (0..1000).for_each(|_| board.note_line("x"));
        assert!(changes.has_changed().unwrap());
        changes.mark_unchanged();
        assert!(!changes.has_changed().unwrap(), "one change stands for all");
    }

    #[test]
    fn an_event_has_only_what_has_changed() {
        let board = board();
        ["a", "b"].into_iter().for_each(|name| board.note_status(device(name), AgentStatus::new(9, "1")));
        board.note_line("first");
        let (whole, seen) = board.state_since(0);
        assert!(whole.is_whole && whole.devices.len() == 2 && whole.log.len() == 1);
        for step in 1..=1000 {
            let status = AgentStatus { step, ..AgentStatus::new(1000, "1") };
            board.note_status(device("b"), status);
        }
        board.note_line("second");
        let (change, _) = board.state_since(seen);
        let names: Vec<&str> = change.devices.iter().map(|its| its.device.as_str()).collect();
        assert_eq!((change.is_whole, names), (false, vec!["b"]));
        assert_eq!(
            change.devices[0].status.as_ref().unwrap().step,
            1000,
            "one row sums up a thousand changes"
        );
        assert_eq!(change.log.iter().map(|line| line.text.as_str()).collect::<Vec<_>>(), ["second"]);
    }

    #[test]
    fn the_curve_of_a_device_is_short_and_ends_with_the_newest_step() {
        let board = board();
        for step in 1..=5000 {
            let status = AgentStatus {
                phase: AgentPhase::Training,
                step,
                psnr: Some(20.123_456),
                ..AgentStatus::new(5000, "1")
            };
            board.note_status(device("a"), status);
        }
        let curve = board.state().devices[0].curve.clone();
        assert!(curve.len() <= CURVE_POINTS_MAX && curve.len() > CURVE_POINTS_MAX / 2, "{}", curve.len());
        assert_eq!(curve.last(), Some(&[5000.0, 20.12]));
    }

    #[test]
    fn a_kept_status_is_as_old_as_its_time() {
        let board = board();
        let clock_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs();
        for (name, time_s) in [("old", clock_s - 500), ("ahead", clock_s + 500)] {
            let status = AgentStatus { time_s, ..AgentStatus::new(9, "1") };
            board.note_heard(&DeviceStatus { device: device(name), status, is_kept: true });
        }
        let ages: Vec<f64> = board.state().devices.iter().filter_map(|its| its.heard_s_ago).collect();
        assert!(ages[0] < 5.0 && (499.0..520.0).contains(&ages[1]), "{ages:?}");
    }
}
