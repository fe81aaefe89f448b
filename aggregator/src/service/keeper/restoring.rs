//! Makes an older revision the newest one, and keeps it there until the operator asks for a merge.

use std::time::Duration;

use cosurf_link::Node;

use super::{Keeper, Origin};
use crate::merge::MergeError;
use crate::service::error::ServiceError;
use crate::service::event::ServiceEvent;
use crate::service::folder::MADE_FILES;
use crate::service::job::{Job, Outcome};
use crate::service::record::Merging;
use crate::service::restore::{self, Wish, WishedMerge};
use crate::service::round::Round;

impl Keeper {
    /// Begins with what the operator wishes first. A restore stops a running merge; one that the operator has asked for before is
    /// still the first wish.
    pub(super) fn begin_to_restore(&mut self, now: Duration) -> Result<(), ServiceError> {
        let wish = restore::wish(&self.folder)?;
        if wish != Some(Wish::BegunMerge) {
            self.wished_merge = WishedMerge::NotBegun;
        }
        let revision = match wish {
            None => return Ok(()),
            Some(Wish::Restore(revision)) => revision,
            Some(Wish::Unreadable) => {
                let reason =
                    "the file of the wish to restore a revision is damaged and is removed; ask again";
                self.told.push_back(ServiceEvent::SetAside { reason: reason.to_owned() });
                return Ok(restore::end_wish(&self.folder)?);
            }
            Some(Wish::Merge | Wish::BegunMerge) => return self.follow_wished_merge(now),
        };
        let is_running = |(job, _): &(Job, Duration)| {
            job.restores.as_ref().is_some_and(|record| record.revision == revision)
        };
        if self.job.as_ref().is_some_and(is_running) {
            return Ok(());
        }
        match restore::find(&self.folder, revision) {
            Ok((key, record)) => {
                let (stores, inputs) = (self.shelf.stores(), self.shelf.inputs());
                let (globals, work) = (self.globals.clone(), self.work.clone());
                self.job = None; // waits until the merge has stopped
                let job = Job::restore(globals, key, record, stores, inputs, work, self.threads);
                self.job = Some((job, now));
            }
            Err(error) => self.refuse_wish(revision, &error)?,
        }
        Ok(())
    }

    /// Begins the merge that the operator wishes first, or goes on to the next wish once it is made.
    fn follow_wished_merge(&mut self, now: Duration) -> Result<(), ServiceError> {
        let is_to_come = self.is_round_at_once() || self.job.is_some() || self.to_offer;
        match self.wished_merge {
            WishedMerge::NotBegun => {
                self.merge_at_once(now);
                restore::note_begun_merge(&self.folder)?;
                self.wished_merge = WishedMerge::Begun;
                Ok(())
            }
            WishedMerge::Begun if is_to_come => Ok(()),
            WishedMerge::Begun | WishedMerge::Made => {
                restore::end_wish(&self.folder)?;
                self.begin_to_restore(now)
            }
        }
    }

    /// Notes that a merge has ended. If it began before the operator asked for one, that is still to come.
    pub(super) fn end_wished_merge(&mut self) {
        if self.wished_merge == WishedMerge::Begun && !self.is_round_at_once() {
            self.wished_merge = WishedMerge::Made;
        }
    }

    fn is_round_at_once(&self) -> bool {
        self.round.as_ref().is_some_and(Round::is_at_once)
    }

    pub(super) fn refuse_wish(
        &mut self,
        revision: u64,
        error: &dyn std::error::Error,
    ) -> Result<(), ServiceError> {
        let reason = format!("{error}; {}", restore::others(&self.folder, revision));
        self.told.push_back(ServiceEvent::NotRestored { revision, reason });
        Ok(restore::end_wish(&self.folder)?)
    }

    /// Whether the newest revision is a restored one that stays: nobody has asked for a merge since, and no device that it
    /// was merged from was forgotten.
    pub(super) fn is_held(&self) -> bool {
        let Some(record) = Merging::read(&self.folder) else { return false };
        record.restored_from.is_some()
            && self.global.is_some_and(|global| global.model.0 == record.revision)
            && !self.shelf.has_withdrawn(&record.inputs)
            && !self.is_outnumbered()
            && !self.lacks_tiles()
            && MADE_FILES.iter().all(|name| self.folder.join(name).is_file())
    }

    /// Begins anew to restore the revision that must stay, because files of the one that repeats it are damaged or gone.
    /// Returns whether it does. If it cannot, the models are merged.
    pub(super) fn restores_again(&mut self) -> bool {
        let Some(revision) = restore::held(&self.folder) else { return false };
        let wished = restore::find(&self.folder, revision)
            .and_then(|_| Ok(restore::ask_again(&self.folder, revision)?));
        if let Err(error) = wished {
            let reason = error.to_string();
            self.told.push_back(ServiceEvent::NotRestored { revision, reason });
            self.let_go();
            return false;
        }
        true
    }

    /// Ends the wait for more models, and lets the merge replace a restored revision.
    fn merge_at_once(&mut self, now: Duration) {
        self.let_go();
        self.round = Some(Round::at_once(self.round.take(), now));
    }

    /// Lets the next merge replace a restored revision.
    pub(super) fn let_go(&mut self) {
        let record = Merging::read(&self.folder).filter(|record| record.restored_from.is_some());
        let freed = record.map_or(Ok(()), |record| {
            let free = Merging { restored_from: None, ..record };
            free.write(&self.folder)
        });
        if let Err(error) = restore::let_go(&self.folder).and(freed) {
            let reason = format!("the restored revision stays: {error}");
            self.told.push_back(ServiceEvent::DiskFailed { reason });
        }
    }

    /// Tells that the newest revision is a restored one, if it is.
    pub(super) fn tell_restored(&mut self) {
        let record = Merging::read(&self.folder);
        if let Some((from, record)) = record.and_then(|record| Some((record.restored_from?, record))) {
            self.told.push_back(ServiceEvent::Restored { revision: record.revision, from });
        }
    }

    /// Stores a restored revision under a new number, so that devices take it, and offers it to them.
    pub(super) fn publish_restored(
        &mut self,
        node: &mut Node,
        now: Duration,
        outcome: Result<Outcome, MergeError>,
        record: Merging,
    ) -> Result<Option<ServiceEvent>, ServiceError> {
        let from = record.revision;
        let (made, verdict) = match outcome {
            Ok(Outcome { made: Some(made), verdict }) => (made, verdict),
            Ok(_) => return Ok(None),
            Err(error) => return self.refuse_wish(from, &error).map(|()| None),
        };
        let stored = self.globals.keys()?.into_iter().find(|key| key.model.0 == from);
        let views = stored.and_then(|key| self.globals.get(key).ok()).map_or(0, |(header, _)| header.views);
        let Merging { inputs, settings, seconds, .. } = record;
        let (count, kept_out) = (inputs.len(), verdict.kept_out.clone());
        let origin = Origin { views, inputs, settings, seconds, restored_from: Some(from) };
        let offer = self.keep(made, origin, verdict)?;
        restore::hold(&self.folder, from)?;
        restore::end_wish(&self.folder)?;
        let event = self.broadcast(node, now, offer, count, kept_out)?;
        self.tell_restored();
        Ok(Some(event))
    }
}
