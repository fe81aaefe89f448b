//! The settings of a participant's client.

use cosurf_wire::{Reply, Topic, TopicString};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{Filter, RetainForwardRule};

use super::address::BrokerAddress;
use super::settings::{ClientSettings, Login, RECEIVE_MAX};
use super::tls::Tls;
use crate::identity::Identity;
use crate::transport::Outgoing;

/// The broker keeps the session of a disconnected participant for this long: enough for a battery change.
const SESSION_EXPIRY_S: u32 = 3600;

/// The settings of a client.
#[derive(Clone, Debug)]
pub struct MqttConfig {
    /// The broker's address.
    pub broker: BrokerAddress,
    /// The participant. It determines the client id and the subscriptions.
    pub identity: Identity,
    /// What the broker publishes when the connection breaks: [`crate::last_will`].
    pub will: Option<Outgoing>,
    /// Certificates, if the broker requires TLS.
    pub tls: Option<Tls>,
    /// User and password, if the broker asks for them.
    pub login: Option<Login>,
}

impl MqttConfig {
    /// What the client needs of it. It subscribes to everything that its role must read.
    pub(super) fn into_client(self) -> ClientSettings {
        let filters = self.identity.filters();
        self.subscribed_to(&filters, SESSION_EXPIRY_S)
    }

    /// The same for a device that reads only which flights are confirmed, and its cell of the plan. The broker keeps nothing for it.
    pub(super) fn into_reporting_client(self) -> ClientSettings {
        let Identity { site, device, .. } = self.identity;
        let topics =
            [Reply::Flight, Reply::Plan].map(|reply| Topic::LocalReply { device, reply }.to_text(&site));
        self.subscribed_to(&topics, 0)
    }

    /// The same for a device that asks before a flight, as a client beside the device's own.
    pub(super) fn into_asking_client(self) -> ClientSettings {
        let client_id = format!("{}-asking", self.identity.client_id());
        ClientSettings { client_id, ..self.into_reporting_client() }
    }

    /// The same for a client that only reads whether the device is connected. It has no will, which would end the session of
    /// the device. It asks for a session, which shows whether the broker takes it for the device itself.
    pub(super) fn into_presence_client(self) -> ClientSettings {
        let Identity { site, device, .. } = self.identity;
        let topic = Topic::State { device }.to_text(&site);
        let client_id = format!("{}-looking", self.identity.client_id());
        ClientSettings {
            client_id,
            receive_max: 1,
            will: None,
            ..self.subscribed_to(&[topic], SESSION_EXPIRY_S)
        }
    }

    /// The same for a participant that only tries whether it is let in. Of what the broker has kept, it lets it send as
    /// little as MQTT allows. It has no will, which would announce the end of a session that has not begun.
    pub(super) fn into_probing_client(self) -> ClientSettings {
        ClientSettings { receive_max: 1, will: None, ..self.into_client() }
    }

    /// The same for a participant that also reads how far devices are.
    pub(super) fn into_hearing_client(self) -> ClientSettings {
        let mut filters = self.identity.filters();
        filters.push(Topic::status_filter(&self.identity.site));
        self.subscribed_to(&filters, SESSION_EXPIRY_S)
    }

    fn subscribed_to(self, filters: &[TopicString], session_expiry_s: u32) -> ClientSettings {
        let Self { broker, identity, will, tls, login } = self;
        let filters = filters.iter().map(|path| Filter {
            path: path.as_str().to_owned(),
            qos: QoS::AtLeastOnce,
            nolocal: true,
            preserve_retain: false,
            retain_forward_rule: RetainForwardRule::OnEverySubscribe,
        });
        ClientSettings {
            broker,
            tls,
            login,
            client_id: identity.client_id(),
            session_expiry_s,
            receive_max: RECEIVE_MAX,
            will,
            filters: filters.collect(),
        }
    }
}
