//! Shared subscriptions: each message goes to one of the clients that share one.

use std::collections::BTreeMap;
use std::sync::Arc;

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Publish;

use super::super::client::Client;
use super::super::message::Message;
use super::{Router, enqueue};

/// A client that shares a subscription.
struct Member {
    client: Client,
    qos: QoS,
    keeps_retain: bool,
    /// Whether the client is connected and has room.
    is_ready: bool,
}

impl Router {
    /// Queues a message for one client of each shared subscription; returns whether there are any. `interested` are the
    /// clients with a filter that matches.
    pub(super) fn deliver_shared(
        &mut self,
        publish: &Publish,
        message: &Arc<Message>,
        interested: &[Client],
    ) -> bool {
        let groups = self.sharing(message, interested);
        let is_heard = !groups.is_empty();
        for mut group in groups {
            if group.iter().any(|member| member.is_ready) {
                group.retain(|member| member.is_ready);
            }
            self.shared = self.shared.wrapping_add(1);
            let Some(Member { client, qos, keeps_retain, .. }) = group.get(self.shared % group.len()) else {
                continue;
            };
            if let Some(session) = self.sessions.get_mut(client) {
                self.ready.extend(enqueue(session, message, publish, *qos, *keeps_retain));
            }
        }
        is_heard
    }

    /// The clients of each shared subscription that matches a message.
    fn sharing(&self, message: &Message, interested: &[Client]) -> Vec<Vec<Member>> {
        let mut groups: BTreeMap<&str, Vec<Member>> = BTreeMap::new();
        let found = interested.iter().filter_map(|client| Some((client, self.sessions.get(client)?)));
        for (client, session) in found {
            let shared = session.subscriptions.iter().filter(|subscription| subscription.is_shared());
            for subscription in shared.filter(|subscription| subscription.is_match(message.topic())) {
                groups.entry(subscription.path()).or_default().push(Member {
                    client: client.clone(),
                    qos: subscription.qos,
                    keeps_retain: subscription.keeps_retain,
                    is_ready: session.link.is_some() && !session.is_full(message.bytes()),
                });
            }
        }
        groups.into_values().collect()
    }
}
