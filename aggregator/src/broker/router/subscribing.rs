//! How many sessions and subscriptions are kept, and for whom.

use std::time::Instant;

use rumqttc::v5::mqttbytes::v5::{
    Packet, RetainForwardRule, SubAck, Subscribe, SubscribeReasonCode, UnsubAck, UnsubAckReason, Unsubscribe,
};

use super::super::client::{Client, User};
use super::super::filters::FILTER_LEVELS_MAX;
use super::super::retained::Page;
use super::super::session::{SUBSCRIPTIONS_MAX, Session};
use super::super::subscription::Subscription;
use super::super::topics::is_filter;
use super::Router;

/// Limit on sessions for each client that may be connected. Sessions outlive connections. When the limit is reached,
/// the disconnected session that expires first is dropped.
const SESSIONS_PER_CLIENT: usize = 2;
/// Limit on the sessions of one user: the agent's, and those of some tools.
const USER_SESSIONS_MAX: usize = 32;
/// Limit on the subscriptions of one user. An agent has three.
const USER_SUBSCRIPTIONS_MAX: usize = 128;
/// Limit on the subscriptions of all clients, for each client that may be connected. Beyond it, strangers get no more.
const SUBSCRIPTIONS_PER_CLIENT: usize = 8;

impl Router {
    /// Adds subscriptions of a client, and the retained messages that match them.
    pub(in super::super) fn subscribe(&mut self, link: usize, now: Instant, subscribe: Subscribe) {
        let Some(client) = self.links.get(&link).cloned() else { return };
        let id = subscribe.properties.and_then(|properties| properties.id);
        let add = |filter| self.subscribe_to(&client, now, Subscription::new(filter, id));
        let return_codes = subscribe.filters.into_iter().map(add).collect();
        let ack = SubAck { pkid: subscribe.pkid, return_codes, properties: None };
        self.answer(link, Packet::SubAck(ack));
    }

    pub(super) fn subscribe_to(
        &mut self,
        client: &Client,
        now: Instant,
        new: Subscription,
    ) -> SubscribeReasonCode {
        let is_valid = is_filter(new.path()) && is_filter(new.filter());
        let is_deep = new.filter().split('/').count() > FILTER_LEVELS_MAX;
        if !is_valid || is_deep || (new.is_shared() && !new.is_well_shared()) {
            return SubscribeReasonCode::TopicFilterInvalid;
        }
        if !self.access.may_subscribe(client.user(), new.filter()) {
            return SubscribeReasonCode::NotAuthorized;
        }
        let of_session = self.sessions.get(client).map(|session| &session.subscriptions);
        let has_it = of_session.is_some_and(|all| all.iter().any(|old| old.path() == new.path()));
        if !has_it && !self.has_room_for_a_subscription(client, now) {
            return SubscribeReasonCode::QuotaExceeded;
        }
        let Some(session) = self.sessions.get_mut(client) else { return SubscribeReasonCode::Unspecified };
        self.filters.add(new.filter(), session.number, client);
        let granted = new.qos;
        put(session, new, has_it);
        SubscribeReasonCode::Success(granted)
    }

    /// Whether a client may have one more subscription.
    fn has_room_for_a_subscription(&mut self, client: &Client, now: Instant) -> bool {
        let of_client = self.sessions.get(client).map_or(0, |session| session.subscriptions.len());
        if of_client >= SUBSCRIPTIONS_MAX {
            return false;
        }
        if let User::Named(_) = client.user() {
            let counts = self.sessions_of(client).map(|(_, session)| session.subscriptions.len());
            return counts.sum::<usize>() < USER_SUBSCRIPTIONS_MAX;
        }
        if self.is_known(client) {
            return true;
        }
        let is_full = |router: &Self| router.filters.held() >= SUBSCRIPTIONS_PER_CLIENT * router.clients_max;
        while is_full(self) && self.forget_first(|router, other| !router.is_known(other), now) {}
        !is_full(self)
    }

    /// Ends subscriptions of a client.
    pub(in super::super) fn unsubscribe(&mut self, link: usize, unsubscribe: Unsubscribe) {
        let Some(client) = self.links.get(&link) else { return };
        let Some(session) = self.sessions.get_mut(client) else { return };
        let filters = &mut self.filters;
        let reason = |path: String| match session.unsubscribe(&path) {
            Some(ended) => {
                // A shared subscription may have the same filter.
                if session.subscriptions.iter().all(|other| other.filter() != ended.filter()) {
                    filters.remove(ended.filter(), session.number);
                }
                UnsubAckReason::Success
            }
            None => UnsubAckReason::NoSubscriptionExisted,
        };
        let reasons = unsubscribe.filters.into_iter().map(reason).collect();
        self.answer(link, Packet::UnsubAck(UnsubAck { pkid: unsubscribe.pkid, reasons, properties: None }));
    }

    /// Makes room for a new session of a client: a user's own sessions give way first.
    pub(super) fn forget_excess(&mut self, client: &Client, now: Instant) {
        if let User::Named(_) = client.user() {
            let is_own = |_: &Self, other: &Client| other.user() == client.user();
            while self.sessions_of(client).count() >= USER_SESSIONS_MAX && self.forget_first(is_own, now) {}
        }
        let is_full = |router: &Self| router.sessions.len() >= SESSIONS_PER_CLIENT * router.clients_max;
        while is_full(self) && self.forget_first(|_, _| true, now) {}
    }

    /// The sessions of a client's user. They follow each other in the order of clients.
    fn sessions_of<'a>(&'a self, client: &'a Client) -> impl Iterator<Item = (&'a Client, &'a Session)> {
        let first = Client::new(client.user().clone(), "");
        self.sessions.range(first..).take_while(|(other, _)| other.user() == client.user())
    }

    /// Drops the disconnected session that expires first, strangers' sessions before others; false if there is none
    /// that `may_go`.
    fn forget_first(&mut self, may_go: impl Fn(&Self, &Client) -> bool, now: Instant) -> bool {
        let away = self.sessions.iter().filter_map(|(client, session)| Some((session.expires?, client)));
        let away = away.filter(|(_, client)| may_go(self, client));
        let first = away.map(|(expires, client)| (self.is_known(client), expires, client)).min();
        let first = first.map(|(_, _, client)| client.clone());
        first.iter().for_each(|client| self.end_session(client, now));
        first.is_some()
    }
}

/// Adds a subscription in place of the one with the same filter, which is there if `has_it`.
fn put(session: &mut Session, new: Subscription, has_it: bool) {
    session.subscriptions.retain(|old| old.path() != new.path());
    let wants_retained = match new.retain_rule {
        RetainForwardRule::OnEverySubscribe => true,
        RetainForwardRule::OnNewSubscribe => !has_it,
        RetainForwardRule::Never => false,
    };
    if wants_retained && !new.is_shared() {
        session.open(Page::new(new.path(), new.qos));
    }
    session.subscriptions.push(new);
    session.weigh();
}
