//! Subscriptions of one client.

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{Filter, RetainForwardRule};

use super::topics::matches;

/// What a subscription takes beside its filter, bytes, with its place among the filters of all sessions.
const SUBSCRIPTION_BYTES: usize = 512;
/// The start of the filter of a shared subscription: `$share/NAME/FILTER`.
const SHARED: &str = "$share/";

/// A client's subscription.
#[derive(Debug)]
pub(super) struct Subscription {
    /// The filter as the client wrote it.
    path: Box<str>,
    /// Where the part of `path` begins that topics are compared with.
    start: usize,
    pub(super) qos: QoS,
    /// Whether the client's own messages do not count.
    no_local: bool,
    /// Whether messages keep their retain flag.
    pub(super) keeps_retain: bool,
    pub(super) retain_rule: RetainForwardRule,
    /// The number that goes along with each message.
    id: Option<usize>,
}

impl Subscription {
    /// Reads a filter. It is not checked.
    pub(super) fn new(filter: Filter, id: Option<usize>) -> Self {
        let start = filter.path.strip_prefix(SHARED).and_then(|rest| rest.find('/'));
        Self {
            start: start.map_or(0, |slash| SHARED.len() + slash + 1),
            path: filter.path.into(),
            qos: filter.qos,
            no_local: filter.nolocal,
            keeps_retain: filter.preserve_retain,
            retain_rule: filter.retain_forward_rule,
            id,
        }
    }

    /// The filter as the client wrote it.
    pub(super) fn path(&self) -> &str {
        &self.path
    }

    /// The filter that topics are compared with.
    pub(super) fn filter(&self) -> &str {
        &self.path[self.start..]
    }

    /// Whether each message goes to only one of the clients with this subscription.
    pub(super) fn is_shared(&self) -> bool {
        self.path.starts_with(SHARED)
    }

    /// Whether a shared subscription has a name without wildcards, and an option that it may have.
    pub(super) fn is_well_shared(&self) -> bool {
        let name = self.path.get(SHARED.len()..self.start.saturating_sub(1)).unwrap_or_default();
        !name.is_empty() && !name.contains(['+', '#']) && !self.no_local
    }

    pub(super) fn is_match(&self, topic: &str) -> bool {
        matches(topic, self.filter())
    }

    /// What the subscription takes in memory, bytes.
    pub(super) fn bytes(&self) -> usize {
        2 * self.path.len() + SUBSCRIPTION_BYTES
    }
}

/// The subscription that decides how a client gets a message that it published itself or not (`is_own`): the one with
/// the highest QoS. Shared ones do not count.
pub(super) fn wanted<'a>(all: &'a [Subscription], topic: &str, is_own: bool) -> Option<&'a Subscription> {
    let is_out = |one: &Subscription| one.is_shared() || (is_own && one.no_local);
    let wanted = all.iter().filter(|one| !is_out(one));
    wanted.filter(|one| one.is_match(topic)).max_by_key(|one| one.qos as u8)
}

/// The numbers that the client gave to its subscriptions to `topic`.
pub(super) fn ids(all: &[Subscription], topic: &str) -> Vec<usize> {
    all.iter().filter(|one| one.id.is_some() && one.is_match(topic)).filter_map(|one| one.id).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_subscriptions_have_a_name_and_a_filter() {
        for (path, filter, is_well_shared) in [
            ("$share/a/b/+", "b/+", true),
            ("$share/a//", "/", true),
            ("$share/+/b", "b", false),
            ("$share//b", "b", false),
            ("$share/a", "$share/a", false),
        ] {
            let subscription = Subscription::new(Filter::new(path, QoS::AtLeastOnce), None);
            assert!(subscription.is_shared(), "{path}");
            assert_eq!(
                (subscription.filter(), subscription.is_well_shared()),
                (filter, is_well_shared),
                "{path}"
            );
        }
        let plain = Subscription::new(Filter::new("a/#", QoS::AtLeastOnce), None);
        assert!(!plain.is_shared() && plain.filter() == "a/#");
    }
}
