//! State and actions of a service. The disk is authoritative: a restarted service reads models, revisions and
//! withdrawals back from its folder.

mod restoring;
mod sending;

use std::collections::{BTreeSet, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Duration;

use cosurf_link::{DEVICES_MAX, Damaged, ModelKey, ModelStore, Node, NodeEvent, Offer, Receiver as Listed};
use cosurf_scene::{Camera, SceneError, Splats, camera_list, check_space, ply};
use cosurf_wire::{BodyHash, DeviceId, ModelHeader, ModelId, ModelKind, RefusalReason, TileId, WireError};

use super::above::{Above, AboveLink};
use super::control::{Command, ServiceConfig};
use super::cut::{Cut, WHOLE_SPLATS_MAX};
use super::error::ServiceError;
use super::event::ServiceEvent;
use super::folder::{MADE_FILES, global_ply, global_store, handed_on, make_folders, sent_tiles, tiles};
use super::inputs::{Input, Inputs};
use super::job::{Job, JobState, Made, Outcome, TileWork};
use super::rebroadcast::Rebroadcast;
use super::record::{Merging, Verdict, file_hash, remove_global};
use super::reporting::Reporting;
use super::restore::{self, WishedMerge};
use super::revoked::revoked;
use super::round::{Expected, Round};
use super::sent::{Revision, Sent, TileBytes};
use super::set_aside::set_aside_files;
use super::shelf::Shelf;
use super::trial::Trials;

use crate::merge::{MergeError, MergeSettings, Merged, keep_only};
use crate::queue::Queue;
use crate::quiet::Quiet;
use crate::store::Store;

/// Number of revisions of the global model that are kept. Each is as large as the site.
pub(super) const REVISIONS_KEPT: usize = 8;
/// Pause before a failed merge or write is tried again.
const DISK_RETRY: Duration = Duration::from_secs(5);
/// Interval at which the folder is checked for withdrawals.
const WITHDRAWALS_EVERY: Duration = Duration::from_secs(1);

/// Interval at which the files of the models are looked for.
const LOST_EVERY: Duration = Duration::from_secs(10);

/// What the commands that have arrived so far ask for, in ascending urgency.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum RunState {
    Running,
    /// Finish a merge that is due, then end.
    Finishing,
    Stopping,
}

/// Where a revision comes from.
struct Origin {
    /// Number of pictures that it was trained on.
    views: u32,
    inputs: Vec<Input>,
    settings: MergeSettings,
    /// Duration of its merge.
    seconds: f64,
    /// The older revision that it repeats.
    restored_from: Option<u64>,
}

/// The state of a service, with the actions that change it.
#[derive(Debug)]
pub(super) struct Keeper {
    device: DeviceId,
    /// Number of the service's session.
    session: u64,
    folder: PathBuf,
    shelf: Shelf,
    globals: ModelStore,
    /// Who distils tiles. Their results are kept, so that a merge need not distil again what has not changed.
    pub(super) work: TileWork,
    /// The tiles of the global model, if it is too large to be sent whole.
    sent: Sent,
    /// What devices get of the global model of the aggregator above.
    handed: Sent,
    /// The highest number that devices may have of a revision whose file was set aside or lost.
    used: Option<ModelId>,
    /// The aggregator above, if there is one.
    above: Option<Above>,
    rebroadcast: Rebroadcast,
    withdrawals_at: Duration,
    lost_at: Duration,
    /// Models that were missing or set aside at the start.
    missing: Vec<ModelKey>,
    trials: Trials,
    global: Option<ModelHeader>,
    expected: Expected,
    given_up: BTreeSet<DeviceId>,
    /// Devices whose messages the link ignores.
    revoked: BTreeSet<DeviceId>,
    merge: MergeSettings,
    threads: usize,
    round: Option<Round>,
    /// When a failed merge or write may be tried again.
    retry_at: Duration,
    /// How far the merge is that the operator wishes first.
    wished_merge: WishedMerge,
    /// The running merge, and the time at which it began.
    job: Option<(Job, Duration)>,
    /// Reports of revisions, if any are made.
    reporting: Option<Reporting>,
    /// Limit on the devices whose models are kept.
    devices_max: usize,
    quiet: Quiet,
    /// Events still to be reported.
    told: VecDeque<ServiceEvent>,
    /// True if the newest revision was merged from the models that count now, and must still be offered to
    /// the agents.
    to_offer: bool,
}

impl Keeper {
    /// Opens the service's folder. Also returns the headers of the local models in it.
    pub(super) fn open(config: ServiceConfig) -> Result<(Self, Vec<ModelHeader>), ServiceError> {
        make_folders(&config.folder)?;
        let mut told: VecDeque<ServiceEvent> = set_aside_files(&config.folder)?.into();
        let mut tell = |damaged: Damaged, follows: &str| {
            told.push_back(ServiceEvent::SetAside { reason: format!("{damaged}; {follows}") });
        };
        let (mut shelf, headers) = Shelf::open(&config.folder, config.identity.session, &mut tell)?;
        let mut tell_global = |damaged| tell(damaged, "a revision that needs it is made anew");
        let (globals, revisions) = ModelStore::open_telling(&global_store(&config.folder), &mut tell_global)?;
        let sent = Sent::open(&sent_tiles(&config.folder), &mut tell_global)?;
        let handed = Sent::open(&handed_on(&config.folder), &mut tell_global)?;
        let set_aside = [&globals, sent.store(), handed.store()].map(ModelStore::highest_set_aside);
        let results = Store::in_folder(&tiles(&config.folder)).map_err(MergeError::from)?;
        let (trials, died) = Trials::open(&config.folder)?;
        let revoked = revoked(&config.folder)?;
        let record = Merging::read(&config.folder);
        if let Some(from) = record.as_ref().and_then(|record| record.restored_from) {
            restore::hold(&config.folder, from)?;
        }
        let (merged, revision) =
            record.map(|record| (record.inputs, Some(ModelId(record.revision)))).unwrap_or_default();
        let mut missing = shelf.take_damaged();
        missing.extend(merged.iter().filter_map(|input| shelf.lacks(input)));
        let mut used = revision.filter(|revision| !revision.is_tile());
        for highest in set_aside {
            used = used.max(highest?);
        }
        told.extend(died);
        let keeper = Self {
            device: config.identity.device,
            session: config.identity.session,
            folder: config.folder,
            shelf,
            globals,
            work: TileWork { results, queue: None, whole_splats_max: WHOLE_SPLATS_MAX },
            sent,
            handed,
            used,
            above: None,
            rebroadcast: Rebroadcast::default(),
            withdrawals_at: Duration::ZERO,
            lost_at: Duration::ZERO,
            missing,
            trials,
            global: revisions.into_iter().max_by_key(|header| header.model),
            expected: config.expected,
            given_up: BTreeSet::new(),
            revoked,
            merge: config.merge,
            threads: config.threads,
            round: (!headers.is_empty()).then(|| Round::extend(None, Duration::ZERO)),
            retry_at: Duration::ZERO,
            wished_merge: WishedMerge::NotBegun,
            job: None,
            reporting: None,
            devices_max: DEVICES_MAX,
            quiet: Quiet::default(),
            told,
            to_offer: false,
        };
        Ok((keeper, headers))
    }

    /// Sets the limit on the devices whose models are kept.
    pub(super) fn set_devices_max(&mut self, devices_max: usize) {
        self.devices_max = devices_max;
    }

    /// Lets workers distil the tiles of merges. Their results are kept in `results`, which nobody else may use.
    pub(super) fn employ(&mut self, results: Store, queue: Queue) {
        (self.work.results, self.work.queue) = (results, Some(Arc::new(queue)));
    }

    /// Makes a report of each revision while no models are merged.
    pub(super) fn report(&mut self, reporting: Reporting) {
        self.reporting = Some(reporting);
    }

    /// Hands the global model of the aggregator above on to the devices. Revisions of the service's own wait for the next
    /// model from above, at most for `wait`.
    pub(super) fn follow(&mut self, link: AboveLink, wait: Duration) {
        self.above = Some(Above::new(link, wait));
    }

    /// The models that would be merged now: the newest of each device.
    #[cfg(test)]
    pub(super) fn counted(&self) -> Vec<ModelKey> {
        self.shelf.newest().iter().map(ModelKey::from).collect()
    }

    /// The header of the newest revision.
    pub(super) fn global(&self) -> Option<ModelHeader> {
        self.global
    }

    /// The devices whose messages the link must ignore.
    pub(super) fn revoked(&self) -> BTreeSet<DeviceId> {
        self.revoked.clone()
    }

    /// Whether a merge is running, or its result is not yet offered to the agents.
    pub(super) fn is_merging(&self) -> bool {
        self.job.is_some() || self.to_offer
    }

    /// Whether the round is over, so that the next merge begins as soon as none is running.
    pub(super) fn is_due(&self, now: Duration) -> bool {
        if now < self.retry_at {
            return false;
        }
        let here = self.shelf.newest().iter().map(|header| header.device).collect();
        self.round.as_ref().is_some_and(|round| round.is_over(&self.expected, &here, &self.given_up, now))
    }

    /// Handles an event of the link. Returns the event to report, if there is one.
    pub(super) fn take(&mut self, node: &mut Node, event: NodeEvent, now: Duration) -> Option<ServiceEvent> {
        Some(match event {
            NodeEvent::Connected => ServiceEvent::Connected,
            NodeEvent::Disconnected { attempt, reason } => ServiceEvent::Disconnected { attempt, reason },
            NodeEvent::Store { header, body } => self.store(node, header, &body, now),
            NodeEvent::Ignored { source, .. } | NodeEvent::OtherVersion { source, .. }
                if !self.quiet.notes(now, source) =>
            {
                return None;
            }
            NodeEvent::Refused { key, .. } if !self.quiet.notes(now, Some(key.device)) => return None,
            NodeEvent::Ignored { topic, reason, .. } => {
                ServiceEvent::Ignored { reason: format!("{topic}: {reason}") }
            }
            NodeEvent::OtherVersion { source, version } => {
                let from = source.map_or_else(|| "a message".to_owned(), |device| device.to_string());
                ServiceEvent::Ignored { reason: format!("{from}: {}", WireError::UnknownVersion(version)) }
            }
            NodeEvent::AskedAgain { by, .. } => {
                self.rebroadcast.again(by);
                if !self.quiet.notes(now, Some(by)) {
                    return None;
                }
                ServiceEvent::LostThere { device: by }
            }
            NodeEvent::Uploaded(key, _) if key.model.is_tile() => return None,
            NodeEvent::Uploaded(..) if self.rebroadcast.is_running() => {
                self.rebroadcast.announced();
                return None;
            }
            NodeEvent::Uploaded(..) => ServiceEvent::Delivered,
            NodeEvent::UploadRefused { key, by, reason } => {
                let is_from_elsewhere =
                    matches!(reason, RefusalReason::NumberTaken | RefusalReason::Replayed);
                match is_from_elsewhere && self.jump(key.model, now) {
                    true => ServiceEvent::Outnumbered { by },
                    false => ServiceEvent::Refused { by, reason },
                }
            }
            NodeEvent::Refused { key, reason } => {
                let remedy = match reason {
                    RefusalReason::Busy => "; raise `uploads_max` or `memory` if this goes on",
                    RefusalReason::TooLarge => "; raise `memory`",
                    _ => "",
                };
                ServiceEvent::Ignored { reason: format!("model {key} is refused: {reason}{remedy}") }
            }
            NodeEvent::TooManyDevices { device, devices_max } => ServiceEvent::Ignored {
                reason: format!(
                    "{device} is more than the {devices_max} devices allowed; raise `devices_max`"
                ),
            },
            NodeEvent::LinkTooNarrow(error) => {
                ServiceEvent::Ignored { reason: format!("the link cannot carry our messages: {error}") }
            }
            NodeEvent::OlderSession { sender, .. } if !self.quiet.notes(now, Some(sender)) => return None,
            NodeEvent::OlderSession { sender, heard } => ServiceEvent::OlderSession { device: sender, heard },
            NodeEvent::SameName(device) => ServiceEvent::SameName { device },
            NodeEvent::Denied(reason) => ServiceEvent::Denied { reason },
            NodeEvent::FlightPledged { device, session, cameras_blake3 } => {
                if self.shelf.pledge(device, session, cameras_blake3) {
                    node.confirm_flights(self.confirmed_flights());
                }
                return None;
            }
            NodeEvent::State(_)
            | NodeEvent::Flight { .. }
            | NodeEvent::ConfirmedFlights(_)
            | NodeEvent::Plan { .. }
            | NodeEvent::Receiving(_)
            | NodeEvent::Known(_)
            | NodeEvent::Unanswered { .. }
            | NodeEvent::Progress(..) => return None,
        })
    }

    /// Deletes the announced flights of devices that were withdrawn. They no longer count.
    fn void_flights(&mut self, node: &mut Node) {
        let withdrawn: Vec<DeviceId> = self.shelf.take_void_flights().collect();
        if !withdrawn.is_empty() {
            withdrawn.into_iter().for_each(|device| node.clear_flight(device));
            node.confirm_flights(self.confirmed_flights());
        }
    }

    /// The flights that count. Those of revoked devices do not: nobody must leave ground to them.
    fn confirmed_flights(&self) -> Vec<(DeviceId, BodyHash)> {
        let mut flights = self.shelf.confirmed_flights();
        flights.retain(|(device, _)| !self.revoked.contains(device));
        flights
    }

    fn store(&mut self, node: &mut Node, header: ModelHeader, body: &[u8], now: Duration) -> ServiceEvent {
        let key = ModelKey::from(header);
        if let Some(reason) = self.objection(&header) {
            node.refuse(key, reason);
            return ServiceEvent::Ignored { reason: format!("model {key} is refused: {reason}") };
        }
        if let Err(error) = self.shelf.put(header, body) {
            node.store_failed(key);
            let reason = match check_space(&self.folder, header.body_bytes) {
                Err(full) => full.to_string(),
                Ok(()) => error.to_string(),
            };
            return ServiceEvent::DiskFailed { reason: format!("model {key} is not stored: {reason}") };
        }
        node.stored(key);
        self.round = Some(Round::extend_by(self.round.take(), header.device, now));
        let in_use = self.job.as_ref().map(|(job, _)| job.inputs.recorded()).unwrap_or_default();
        if let Err(error) = self.shelf.remove_replaced(header.device, &in_use) {
            let reason = format!("older models of {} are not removed: {error}", header.device);
            self.told.push_back(ServiceEvent::DiskFailed { reason });
        }
        ServiceEvent::Stored { header }
    }

    /// Why a complete model is not kept.
    fn objection(&self, header: &ModelHeader) -> Option<RefusalReason> {
        let is_beyond = !self.shelf.knows(&header.device) && self.shelf.devices() >= self.devices_max;
        match self.shelf.is_withdrawn(header) {
            true => Some(RefusalReason::Withdrawn),
            false => is_beyond.then_some(RefusalReason::TooManyDevices),
        }
    }

    /// Carries out the commands that have arrived.
    pub(super) fn obey(&mut self, node: &mut Node, commands: &Receiver<Command>, now: Duration) -> RunState {
        loop {
            match commands.try_recv() {
                Ok(Command::GiveUp(device)) => {
                    self.given_up.insert(device);
                    self.round = Some(Round::extend(self.round.take(), now));
                }
                Ok(Command::Finish) => {
                    self.begin_when_due(node, now);
                    return RunState::Finishing;
                }
                Ok(Command::Stop) | Err(TryRecvError::Disconnected) => return RunState::Stopping,
                Err(TryRecvError::Empty) => return RunState::Running,
            }
        }
    }

    /// Reports a pending event, withdraws devices, begins a merge that is due, or publishes a finished merge.
    /// Returns the event to report, if there is one.
    pub(super) fn work(&mut self, node: &mut Node, now: Duration) -> Option<ServiceEvent> {
        self.void_flights(node);
        self.shelf.take_forgotten().for_each(|key| node.forget(key));
        self.missing.drain(..).for_each(|key| node.ask_again(key));
        if let Some((source, more)) = self.quiet.summary(now) {
            let from = source.map_or_else(|| "other sources".to_owned(), |device| device.to_string());
            let reason = format!("{more} more messages like these from {from}");
            return Some(ServiceEvent::Ignored { reason });
        }
        if let Some(event) = self.told.pop_front() {
            return Some(event);
        }
        match self.rebroadcast.send(node) {
            Ok(true) => return Some(ServiceEvent::Delivered),
            Ok(false) => {}
            Err(error) => return Some(self.disk_failed(&error, now)),
        }
        if now < self.retry_at {
            return None;
        }
        if now >= self.lost_at {
            self.lost_at = now + LOST_EVERY;
            if let Err(error) = self.find_lost(node, now, false) {
                return Some(self.disk_failed(&error, now));
            }
        }
        if let Err(error) = self.follow_above(node, now) {
            let is_outdated = self.above.as_mut().is_some_and(Above::forget_newest);
            return (!is_outdated).then(|| self.disk_failed(&error, now));
        }
        let done = self.withdraw_when_due(node, now).transpose().or_else(|| {
            self.begin_when_due(node, now);
            self.publish_when_done(node, now).transpose()
        });
        let done = done.map(|outcome| outcome.unwrap_or_else(|error| self.disk_failed(&error, now)));
        done.or_else(|| self.report_when_idle(now))
    }

    /// Makes the report of the newest revision if there is nothing to merge. Returns the event of a report that was made.
    fn report_when_idle(&mut self, now: Duration) -> Option<ServiceEvent> {
        let is_idle = self.round.is_none() && !self.is_merging();
        let reporting = self.reporting.as_mut()?;
        let event = reporting.poll(now);
        if let Some(global) = self.global.filter(|_| is_idle) {
            reporting.begin(global.model, now);
        }
        event
    }

    /// Asks for stored models again whose files are missing or, if `reads_all`, damaged. Returns whether there are any.
    fn find_lost(&mut self, node: &mut Node, now: Duration, reads_all: bool) -> Result<bool, ServiceError> {
        let lost = self.shelf.drop_lost(reads_all)?;
        for (header, reason) in &lost {
            node.ask_again(header.into());
            self.round = Some(Round::extend(self.round.take(), now));
            self.told.push_back(ServiceEvent::Lost { header: *header, reason: reason.clone() });
        }
        Ok(!lost.is_empty())
    }

    /// Schedules another attempt after a failed merge or write.
    fn disk_failed(&mut self, error: &ServiceError, now: Duration) -> ServiceEvent {
        self.retry_at = now + DISK_RETRY;
        self.round = Some(Round::extend(self.round.take(), now));
        ServiceEvent::DiskFailed { reason: format!("the global model is not stored: {error}") }
    }

    /// Carries out what the operator has asked for in the folder: withdrawals, revocations, and a restored revision.
    fn withdraw_when_due(
        &mut self,
        node: &mut Node,
        now: Duration,
    ) -> Result<Option<ServiceEvent>, ServiceError> {
        if now < self.withdrawals_at {
            return Ok(None);
        }
        self.withdrawals_at = now + WITHDRAWALS_EVERY;
        self.revoke_devices(node)?;
        self.begin_to_restore(now)?;
        let withdrawn = self.shelf.withdraw_devices()?;
        if !withdrawn.is_empty() {
            let record = Merging::read(&self.folder);
            let is_shown = record.is_some_and(|record| self.shelf.has_withdrawn(&record.inputs));
            // Too few devices may be left for a quorum, and what is withdrawn must not stay for as long as the deadline.
            self.round = Some(match (is_shown, &self.expected) {
                (true, Expected::Anybody(_)) => Round::at_once(self.round.take(), now),
                _ => Round::extend(self.round.take(), now),
            });
        }
        self.told.extend(withdrawn.into_iter().map(|device| ServiceEvent::Withdrawn { device }));
        if self.shelf.is_emptied() {
            (self.job, self.to_offer) = (None, false);
            self.withdraw_global(node)?;
        }
        Ok(self.told.pop_front())
    }

    /// Lets the link ignore the devices that are revoked now.
    fn revoke_devices(&mut self, node: &mut Node) -> Result<(), ServiceError> {
        let now_revoked = revoked(&self.folder)?;
        if now_revoked == self.revoked {
            return Ok(());
        }
        node.revoke(now_revoked.clone());
        let before = std::mem::replace(&mut self.revoked, now_revoked);
        let newly = self.revoked.difference(&before).map(|device| ServiceEvent::Revoked { device: *device });
        let again =
            before.difference(&self.revoked).map(|device| ServiceEvent::Readmitted { device: *device });
        self.told.extend(newly.chain(again));
        // Nobody must leave ground to a device that can send no model of it.
        self.revoked.difference(&before).for_each(|device| node.clear_flight(*device));
        node.confirm_flights(self.confirmed_flights());
        Ok(())
    }

    /// Removes the newest global model and its tiles, because it was merged from withdrawn models. Its revision in
    /// `global/` stays, so that the next revision has a higher number.
    fn withdraw_global(&mut self, node: &mut Node) -> Result<(), ServiceError> {
        keep_only(&self.work.results, &[])?;
        if let Some(reporting) = &mut self.reporting {
            reporting.end();
        }
        self.rebroadcast.stop(node);
        self.sent.clear()?;
        if let Some(above) = &mut self.above {
            above.stop_waiting();
        }
        if remove_global(&self.folder)? {
            node.withdraw_global(TileId::WHOLE);
            self.told.push_back(ServiceEvent::GlobalWithdrawn);
        }
        Ok(())
    }

    /// If the round is over and no merge is running, ends the round and begins a merge of the models that count. A
    /// running merge is stopped only if it uses withdrawn models: else frequent arrivals would let none end. If the
    /// newest revision was merged from these models, it will be offered again instead.
    fn begin_when_due(&mut self, node: &mut Node, now: Duration) {
        if !self.is_due(now) {
            return;
        }
        if let Some((job, _)) = &self.job {
            if !self.shelf.has_withdrawn(&job.recorded()) {
                return;
            }
            self.job = None; // dropping a job waits until its merge has stopped
        }
        if self.reporting.as_mut().is_some_and(Reporting::is_in_the_way) {
            return;
        }
        self.round = None;
        self.told.extend(self.shelf.take_parts(node));
        let inputs = self.trials.admit(self.shelf.inputs());
        if inputs == Inputs::default() {
            return;
        }
        if self.is_held() || self.is_merged(&inputs) {
            self.to_offer = true;
            return;
        }
        if self.restores_again() {
            return;
        }
        let (stores, work) = (self.shelf.stores(), self.work.clone());
        let watch = match self.trials.begin(&inputs) {
            Ok(watch) => Some(Arc::new(watch)),
            Err(error) => {
                let reason = format!("it is not noted which model a merge reads: {error}");
                self.told.push_back(ServiceEvent::DiskFailed { reason });
                None
            }
        };
        let job = Job::start(stores, inputs, self.merge, self.folder.clone(), work, self.threads, watch);
        self.job = Some((job, now));
    }

    /// Whether the newest revision was merged from these models with the current settings.
    fn is_merged(&self, inputs: &Inputs) -> bool {
        let Some(record) = Merging::read(&self.folder) else { return false };
        record.inputs == inputs.recorded()
            && record.settings == self.merge
            && self.global.is_some_and(|global| global.model.0 == record.revision)
            && !self.is_outnumbered()
            && !self.lacks_tiles()
            && MADE_FILES.iter().all(|name| self.folder.join(name).is_file())
    }

    /// Stores a finished merge and offers it to the agents, or offers the newest revision again.
    fn publish_when_done(
        &mut self,
        node: &mut Node,
        now: Duration,
    ) -> Result<Option<ServiceEvent>, ServiceError> {
        if self.to_offer {
            return self.offer_again(node, now).map(Some);
        }
        let Some((job, begun)) = &mut self.job else { return Ok(None) };
        let outcome = match job.poll() {
            JobState::Unchanged => return Ok(None),
            JobState::Advanced(progress) => return Ok(Some(ServiceEvent::Merging(progress))),
            JobState::Troubled(reason) => return Ok(Some(ServiceEvent::TileTrouble { reason })),
            JobState::Done(outcome) => outcome,
        };
        let (inputs, seconds) = (std::mem::take(&mut job.inputs), (now - *begun).as_secs_f64());
        let restores = job.restores.take();
        self.job = None;
        self.end_wished_merge();
        if let Some(record) = restores {
            return self.publish_restored(node, now, *outcome, *record);
        }
        if matches!(*outcome, Err(MergeError::Store(_))) && self.find_lost(node, now, true)? {
            return Ok(None);
        }
        let Outcome { made, verdict } = (*outcome)?;
        self.trials.clear(&inputs)?;
        let kept_out = verdict.kept_out.clone();
        let Some(made) = made else {
            // Nothing replaces a global model that shows ground of withdrawn devices.
            if Merging::read(&self.folder).is_some_and(|record| self.shelf.has_withdrawn(&record.inputs)) {
                self.withdraw_global(node)?;
            }
            return Ok(Some(ServiceEvent::NothingMerged { kept_out }));
        };
        let views = inputs.headers().fold(0u32, |views, header| views.saturating_add(header.views));
        let (inputs, settings) = (inputs.recorded(), self.merge);
        let count = inputs.len();
        let origin = Origin { views, inputs, settings, seconds, restored_from: None };
        let offer = self.keep(made, origin, verdict)?;
        self.broadcast(node, now, offer, count, kept_out).map(Some)
    }

    /// Removes all but the newest [`REVISIONS_KEPT`] revisions.
    fn remove_old_revisions(&self) -> Result<(), ServiceError> {
        let mut revisions = self.globals.keys()?;
        revisions.retain(|key| key.device == self.device);
        revisions.sort_by_key(|key| std::cmp::Reverse(key.model));
        revisions.into_iter().skip(REVISIONS_KEPT).try_for_each(|key| self.globals.remove(key))?;
        Ok(())
    }

    /// Writes a merged model to the disk: the revision, its record, and the PLY file for viewers. If the
    /// bytes are those of the newest revision, that revision stays.
    fn keep(
        &mut self,
        Made { merged, frame, body, cut }: Made,
        Origin { views, inputs, settings, seconds, restored_from }: Origin,
        Verdict { kept_out, fitted, fits }: Verdict,
    ) -> Result<Offer, ServiceError> {
        let Merged { model, tiles, summary } = merged;
        let next = self.next_number();
        let mut offer = Offer::from_body(self.device, next, ModelKind::Global, views, body)?;
        match self.global {
            Some(global) if global.blake3 == offer.header.blake3 && !self.is_outnumbered() => {
                offer.header = global;
            }
            _ => {
                let Splats { means, sh_degree, .. } = &model.splats;
                let viewers_bytes = ply::file_bytes(means.len(), *sh_degree, &frame);
                check_space(&self.folder, offer.header.body_bytes + viewers_bytes)?;
                self.globals.put(&offer.header, &offer.body)?;
                self.remove_old_revisions()?;
            }
        }
        self.global = Some(offer.header);
        ply::write(&global_ply(&self.folder), &model.splats, &frame)?;
        let cameras: Vec<Camera> = model.cameras.iter().map(|camera| frame.world_camera(camera)).collect();
        camera_list::write(&self.folder.join(camera_list::FILE), &cameras)?;
        let hashed = |name: &str| Ok((name.to_owned(), file_hash(&self.folder.join(name))?));
        let files_blake3 = MADE_FILES.into_iter().map(hashed).collect::<Result<_, SceneError>>()?;
        let revision = offer.header.model.0;
        let record = Merging {
            revision,
            files_blake3,
            inputs,
            kept_out,
            fitted,
            fits,
            settings,
            summary,
            seconds,
            restored_from,
        };
        record.write(&self.folder)?;
        restore::keep_record(&self.folder, &record)?;
        if let Some(reporting) = &mut self.reporting {
            reporting.outdate();
        }
        if restored_from.is_none() {
            keep_only(&self.work.results, &tiles)?;
        }
        match cut {
            Some(Cut { bodies, receivers }) => {
                let mut listed = self.without_tiles();
                listed.extend(receivers);
                let listed = listed.into_iter().map(|(device, tiles)| Listed { device, tiles }).collect();
                let revision = Revision { device: self.device, number: next, views, beyond: None };
                let bodies = bodies.into_iter().map(TileBytes::Here).collect();
                self.sent.keep_tiles(revision, bodies, listed, frame.origin())?;
            }
            None => self.sent.clear()?,
        }
        Ok(offer)
    }
}
