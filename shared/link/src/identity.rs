//! Who takes part, and on which side.

use cosurf_wire::{DeviceId, Message, SiteId, State, Topic, TopicString};

use crate::transport::Outgoing;

/// Who takes part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// In which site.
    pub site: SiteId,
    /// Under which name; two at once under one name throw each other out.
    pub device: DeviceId,
    /// Number of this session, greater than any before: [`crate::next_session`].
    pub session: u64,
    /// On which side.
    pub role: Role,
}

/// On which side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Sends local models, receives global ones.
    Device,
    /// Receives local models, sends global ones.
    Aggregator,
}

impl Identity {
    /// What this participant listens to, with MQTT's wildcards.
    pub fn filters(&self) -> Vec<TopicString> {
        match self.role {
            Role::Device => Topic::device_filters(&self.site, &self.device).to_vec(),
            Role::Aggregator => Topic::aggregator_filters(&self.site).to_vec(),
        }
    }

    /// Its birth, or its death, as a retained message.
    pub fn state_message(&self, alive: bool) -> Outgoing {
        let state = State { device: self.device, session: self.session, alive };
        Outgoing::new(&self.site, Topic::State { device: self.device }, &Message::State(state), true)
    }
}
