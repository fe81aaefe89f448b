//! The identity of a participant.

use cosurf_wire::{DeviceId, Message, SiteId, State, Topic, TopicString};

use crate::transport::Outgoing;

/// The identity of a participant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The site.
    pub site: SiteId,
    /// The participant's name, unique in the site. If another client connects under the same name, the broker
    /// disconnects this one.
    pub device: DeviceId,
    /// Number of this session, greater than those of all earlier sessions: see [`crate::next_session`].
    pub session: u64,
    /// Whether the participant is a device or an aggregator.
    pub role: Role,
}

/// The two kinds of participants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Sends local models, receives global ones.
    Device,
    /// Receives local models, sends global ones.
    Aggregator,
}

impl Identity {
    /// The id of this participant's client at an MQTT broker.
    pub fn client_id(&self) -> String {
        let role = match self.role {
            Role::Device => "agent",
            Role::Aggregator => "aggregator",
        };
        format!("cosurf-{role}-{}-{}", self.site, self.device)
    }

    /// The topic filters that this participant subscribes to, with MQTT wildcards.
    pub fn filters(&self) -> Vec<TopicString> {
        match self.role {
            Role::Device => Topic::device_filters(&self.site, &self.device).to_vec(),
            Role::Aggregator => Topic::aggregator_filters(&self.site).to_vec(),
        }
    }

    /// The retained message that announces the start (`alive`) or the end of the session.
    pub fn state_message(&self, alive: bool) -> Outgoing {
        let state = State { device: self.device, session: self.session, alive };
        Outgoing::new(&self.site, Topic::State { device: self.device }, &Message::State(state), true)
    }
}
