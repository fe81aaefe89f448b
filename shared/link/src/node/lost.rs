//! Models that an aggregator has acknowledged and lost: it asks their devices for them again.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_wire::{Message, Missing, Reply, SiteId, Topic, Want};

use super::births::Births;
use crate::key::ModelKey;
use crate::pacing::{ASK_AGAIN, Backoff};
use crate::transport::Outgoing;

/// The lost models. There are no more than the caller has stored.
#[derive(Debug, Default)]
pub(super) struct Lost(BTreeMap<ModelKey, Asking>);

#[derive(Debug)]
struct Asking {
    at: Duration,
    backoff: Backoff,
}

impl Lost {
    /// Asks for a model from `now` on.
    pub(super) fn add(&mut self, now: Duration, key: ModelKey) {
        self.0.entry(key).or_insert(Asking { at: now, backoff: ASK_AGAIN });
    }

    /// Stops asking: the device offers this model, or a newer one.
    pub(super) fn found(&mut self, offered: ModelKey) {
        self.0.retain(|key, _| key.device != offered.device || key.model > offered.model);
    }

    /// When the next request is due.
    pub(super) fn next_wakeup(&self) -> Option<Duration> {
        self.0.values().map(|asking| asking.at).min()
    }

    /// The next request that is due: a message that the device's model lacks all chunks here. A device that is not known to
    /// be there is not asked.
    pub(super) fn next(&mut self, now: Duration, site: &SiteId, births: &Births) -> Option<Outgoing> {
        for (key, asking) in self.0.iter_mut().filter(|(_, asking)| asking.at <= now) {
            asking.at = now + asking.backoff.delay();
            let Some(session) = births.replied_session(key.device) else { continue };
            let ModelKey { device, model } = *key;
            let want = Want { device, model, session, idle: true, missing: Missing::all() };
            let topic = Topic::LocalReply { device, reply: Reply::Want };
            return Some(Outgoing::new(site, topic, &Message::Want(want), false));
        }
        None
    }
}
