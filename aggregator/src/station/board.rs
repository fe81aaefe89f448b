//! The board: what the ground station knows of a running site. Services, missions and agents' statuses write on it; pages
//! and scripts read it.
//!
//! What it knows nothing about: HTTP, and how models are merged. Everything on it is bounded: devices, lines, and the
//! length of texts. A reader is told only that the board has changed, so a slow one keeps nothing waiting: it reads the
//! newest state, which sums up what it has missed.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use cosurf_contract::{AgentStatus, Escaped};
use cosurf_wire::DeviceId;
use serde::Serialize;
use tokio::sync::watch;

use crate::merge::MergeProgress;
use crate::service::{KeptOut, Merging, ServiceEvent};

/// Largest number of devices; further ones have no row.
const DEVICES_MAX: usize = 1024;
/// Largest number of lines of the log; the oldest ones go.
const LINES_MAX: usize = 300;
/// Longest text of a line, characters.
const LINE_CHARS_MAX: usize = 400;

/// A board. Clones share it.
#[derive(Clone, Debug)]
pub struct Board(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    folder: PathBuf,
    begun: Instant,
    state: Mutex<Notes>,
    /// Number of changes.
    changes: watch::Sender<u64>,
}

/// What is on the board.
#[derive(Clone, Debug, Default)]
struct Notes {
    is_connected: bool,
    merge: Option<MergeProgress>,
    revision: Option<Revision>,
    devices: BTreeMap<DeviceId, Device>,
    log: VecDeque<Line>,
    events: u64,
}

#[derive(Clone, Debug, Default)]
struct Device {
    status: Option<AgentStatus>,
    /// When it was last heard, seconds since the board was made.
    heard_s: Option<f64>,
    model: Option<u64>,
    uploads: u64,
    kept_out: Option<String>,
}

/// A revision of the global model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Revision {
    /// Its number.
    pub(super) revision: u64,
    /// Number of splats.
    splats: usize,
    /// Number of local models that were merged.
    models: usize,
    /// True once its report is in the folder.
    is_reported: bool,
}

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Line {
    /// Seconds since the board was made.
    at_s: f64,
    text: String,
}

/// The state of a site as pages and scripts read it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct State {
    /// Seconds since the program began.
    pub(super) uptime_s: f64,
    /// Whether the broker is reached.
    pub(super) is_connected: bool,
    /// Progress of the merge that is running; absent if none is.
    merge: Option<MergeProgress>,
    /// The newest revision; absent before the first.
    pub(super) revision: Option<Revision>,
    /// The devices, by name.
    pub(super) devices: Vec<DeviceState>,
    /// The newest lines of the log, oldest first.
    log: Vec<Line>,
    /// Number of events so far.
    pub(super) events: u64,
}

/// The state of a device.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct DeviceState {
    /// Its name.
    pub(super) device: String,
    /// Seconds since it was last heard; absent if only its models are known.
    pub(super) heard_s_ago: Option<f64>,
    /// How far it is, as it says itself; absent if it has not said so.
    pub(super) status: Option<AgentStatus>,
    /// Number of its newest model that is stored; absent before the first.
    model: Option<u64>,
    /// Number of models that have arrived since the program began.
    pub(super) uploads: u64,
    /// Why its model is kept out of the newest revision; absent if it is not.
    pub(super) kept_out: Option<String>,
}

impl Board {
    /// An empty board of the service or mission with this folder. A revision that is there already is on it.
    pub fn new(folder: &Path) -> Self {
        let revision = Merging::read(folder).map(|merging| Revision {
            revision: merging.revision,
            splats: merging.summary.splats,
            models: merging.inputs.len() - merging.kept_out.len(),
            is_reported: folder.join("report.html").is_file(),
        });
        let state = Mutex::new(Notes { revision, ..Notes::default() });
        let (changes, _) = watch::channel(0);
        Self(Arc::new(Shared { folder: folder.into(), begun: Instant::now(), state, changes }))
    }

    /// Notes an event of the service.
    pub fn note_service(&self, event: &ServiceEvent) {
        let mut notes = self.notes();
        notes.events += 1;
        notes.follow(event);
        let is_told = !matches!(event, ServiceEvent::Merging(_));
        if is_told {
            notes.write(self.now_s(), &Escaped(event).to_string());
        }
        drop(notes);
        self.tell();
    }

    /// Notes how far an agent is.
    pub fn note_status(&self, device: DeviceId, status: AgentStatus) {
        let now_s = self.now_s();
        let mut notes = self.notes();
        if let Some(known) = notes.device(device) {
            known.status = Some(status);
            known.heard_s = Some(now_s);
        }
        drop(notes);
        self.tell();
    }

    /// Writes a line into the log.
    pub fn note_line(&self, text: &str) {
        self.notes().write(self.now_s(), &Escaped(text).to_string());
        self.tell();
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

    /// The state of the site.
    pub(super) fn state(&self) -> State {
        let (now_s, notes) = (self.now_s(), self.notes());
        let device = |(device, its): (&DeviceId, &Device)| DeviceState {
            device: device.to_string(),
            heard_s_ago: its.heard_s.map(|heard_s| now_s - heard_s),
            status: its.status.clone(),
            model: its.model,
            uploads: its.uploads,
            kept_out: its.kept_out.clone(),
        };
        State {
            uptime_s: now_s,
            is_connected: notes.is_connected,
            merge: notes.merge,
            revision: notes.revision.clone(),
            devices: notes.devices.iter().map(device).collect(),
            log: notes.log.iter().cloned().collect(),
            events: notes.events,
        }
    }

    fn notes(&self) -> MutexGuard<'_, Notes> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now_s(&self) -> f64 {
        self.0.begun.elapsed().as_secs_f64()
    }

    fn tell(&self) {
        self.0.changes.send_modify(|changes| *changes += 1);
    }
}

impl Notes {
    /// The row of a device; `None` if there are too many.
    fn device(&mut self, device: DeviceId) -> Option<&mut Device> {
        if self.devices.len() >= DEVICES_MAX && !self.devices.contains_key(&device) {
            return None;
        }
        Some(self.devices.entry(device).or_default())
    }

    fn follow(&mut self, event: &ServiceEvent) {
        match event {
            ServiceEvent::Connected => self.is_connected = true,
            ServiceEvent::Disconnected { .. } => self.is_connected = false,
            ServiceEvent::Stored { header } => {
                if let Some(device) = self.device(header.device) {
                    (device.model, device.uploads) = (Some(header.model.0), device.uploads + 1);
                }
            }
            ServiceEvent::Merging(progress) => self.merge = Some(*progress),
            ServiceEvent::Merged { header, models, kept_out } => {
                self.keep_out(kept_out);
                let (revision, splats) = (header.model.0, header.splats as usize);
                let models = *models;
                self.revision = Some(Revision { revision, splats, models, is_reported: false });
            }
            ServiceEvent::NothingMerged { kept_out } => self.keep_out(kept_out),
            ServiceEvent::Reported { revision, .. } => {
                let newest = self.revision.as_mut().filter(|newest| newest.revision == *revision);
                newest.into_iter().for_each(|newest| newest.is_reported = true);
            }
            ServiceEvent::Withdrawn { device } => {
                if let Some(device) = self.devices.get_mut(device) {
                    (device.model, device.kept_out) = (None, None);
                }
            }
            ServiceEvent::GlobalWithdrawn => self.revision = None,
            _ => {}
        }
    }

    /// Notes which models a merge that has ended kept out.
    fn keep_out(&mut self, kept_out: &[KeptOut]) {
        self.merge = None;
        for (device, its) in &mut self.devices {
            let its_own = kept_out.iter().find(|kept_out| kept_out.device == device.as_str());
            its.kept_out = its_own.map(|kept_out| kept_out.reason.clone());
        }
    }

    fn write(&mut self, at_s: f64, text: &str) {
        if self.log.len() >= LINES_MAX {
            self.log.pop_front();
        }
        self.log.push_back(Line { at_s, text: text.chars().take(LINE_CHARS_MAX).collect() });
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn device(name: &str) -> DeviceId {
        DeviceId::new(name).unwrap()
    }

    fn board() -> Board {
        Board::new(Path::new("no such folder"))
    }

    #[test]
    fn the_board_shows_who_is_kept_out_until_the_next_merge() {
        let board = board();
        board.note_status(device("a"), AgentStatus::new(300, "1"));
        board.note_status(device("b"), AgentStatus::new(300, "1"));
        let kept_out = KeptOut { device: "b".into(), model: 1, reason: "contradicts a".into() };
        board.note_service(&ServiceEvent::Merging(MergeProgress { step: 1, steps: 9, psnr: 20.0 }));
        assert_eq!(board.state().merge.unwrap().steps, 9);
        board.note_service(&ServiceEvent::NothingMerged { kept_out: vec![kept_out] });
        let state = board.state();
        let reasons: Vec<Option<&str>> = state.devices.iter().map(|its| its.kept_out.as_deref()).collect();
        assert_eq!((reasons, state.merge), (vec![None, Some("contradicts a")], None));
        board.note_service(&ServiceEvent::NothingMerged { kept_out: Vec::new() });
        assert!(board.state().devices.iter().all(|its| its.kept_out.is_none()));
    }

    #[test]
    fn devices_lines_and_texts_are_bounded() {
        let board = board();
        for i in 0..DEVICES_MAX + 10 {
            board.note_status(device(&format!("d-{i}")), AgentStatus::new(1, "1"));
            board.note_line(&"x".repeat(LINE_CHARS_MAX + 7));
        }
        let state = board.state();
        assert_eq!((state.devices.len(), state.log.len()), (DEVICES_MAX, LINES_MAX));
        assert!(state.log.iter().all(|line| line.text.len() == LINE_CHARS_MAX));
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
}
