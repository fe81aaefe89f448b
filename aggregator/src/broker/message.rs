//! Messages as the broker keeps them: once, however many queues they wait in.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::{BufMut, Bytes, BytesMut};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{LastWill, LastWillProperties, Publish, PublishProperties};

use super::memory::{Budget, Charge};
use super::packet::{Version, put_length};

/// What a message takes beside its own bytes: the structures and the allocator's share. Measured by `attack_02`.
const OVERHEAD_BYTES: usize = 320;
/// What a user property takes beside its own bytes.
const PROPERTY_BYTES: usize = 64;

/// A message from a client.
#[derive(Debug)]
pub(super) struct Message {
    topic: Box<str>,
    payload: Bytes,
    properties: Option<Box<PublishProperties>>,
    /// Time after which the message is not delivered.
    expires: Option<Instant>,
    charge: Charge,
}

impl Message {
    /// Keeps a message. Topic and payload are copied, so that no buffer of a socket stays in memory for them.
    pub(super) fn new(budget: &Arc<Budget>, now: Instant, topic: &str, publish: &Publish) -> Self {
        let mut properties = publish.properties.clone().map(Box::new);
        if let Some(data) = properties.as_mut().and_then(|properties| properties.correlation_data.as_mut()) {
            *data = Bytes::copy_from_slice(data);
        }
        let expiry = properties.as_ref().and_then(|properties| properties.message_expiry_interval);
        Self {
            topic: topic.into(),
            payload: Bytes::copy_from_slice(&publish.payload),
            charge: Charge::new(budget, cost(publish)),
            expires: expiry.map(|seconds| now + Duration::from_secs(u64::from(seconds))),
            properties,
        }
    }

    pub(super) fn topic(&self) -> &str {
        &self.topic
    }

    /// What the message takes from the budget, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.charge.bytes()
    }

    pub(super) fn is_expired(&self, now: Instant) -> bool {
        self.expires.is_some_and(|at| at <= now)
    }
}

/// What keeping a message takes, bytes.
pub(super) fn cost(publish: &Publish) -> usize {
    let properties = publish.properties.as_ref();
    let pairs = properties.map_or(0, |properties| properties.user_properties.len());
    publish.size() + OVERHEAD_BYTES + pairs * PROPERTY_BYTES
}

/// A last will as a message to publish.
pub(super) fn will_message(will: LastWill) -> Publish {
    let properties = will.properties.map(|properties| {
        let LastWillProperties {
            payload_format_indicator,
            message_expiry_interval,
            content_type,
            response_topic,
            correlation_data,
            user_properties,
            ..
        } = properties;
        PublishProperties {
            payload_format_indicator,
            message_expiry_interval,
            content_type,
            response_topic,
            correlation_data,
            user_properties,
            ..PublishProperties::default()
        }
    });
    let (topic, payload) = (will.topic, will.message);
    Publish { qos: will.qos, retain: will.retain, topic, payload, properties, ..Publish::default() }
}

/// A message on its way to one client.
#[derive(Clone, Debug)]
pub(super) struct Delivery {
    pub(super) message: Arc<Message>,
    pub(super) qos: QoS,
    pub(super) retain: bool,
    pub(super) dup: bool,
    /// Packet id; 0 until the message is sent with QoS 1 or 2.
    pub(super) pkid: u16,
}

impl Delivery {
    /// Whether the client acknowledges the message.
    pub(super) fn is_acknowledged(&self) -> bool {
        self.qos != QoS::AtMostOnce
    }

    /// Writes the PUBLISH packet with the identifiers `ids` of the client's subscriptions, unless it would be larger
    /// than `bytes_max`; returns whether it was written.
    pub(super) fn write(
        &self,
        now: Instant,
        version: Version,
        bytes_max: usize,
        ids: Vec<usize>,
        out: &mut BytesMut,
    ) -> bool {
        let message = &self.message;
        let properties = self.properties(now, version, ids);
        let id_bytes = if self.is_acknowledged() { 2 } else { 0 };
        let length = 2 + message.topic.len() + id_bytes + properties.len() + message.payload.len();
        if length + 5 > bytes_max {
            return false;
        }
        out.reserve(length + 5);
        out.put_u8(0x30 | u8::from(self.dup) << 3 | (self.qos as u8) << 1 | u8::from(self.retain));
        put_length(out, length);
        out.put_u16(message.topic.len() as u16);
        out.put_slice(message.topic.as_bytes());
        if id_bytes > 0 {
            out.put_u16(self.pkid);
        }
        out.put_slice(&properties);
        out.put_slice(&message.payload);
        true
    }

    /// The properties with their length, as MQTT 5 writes them; nothing in MQTT 3.1.1. The rest of the time until the
    /// message expires goes along.
    fn properties(&self, now: Instant, version: Version, ids: Vec<usize>) -> BytesMut {
        let mut bytes = BytesMut::new();
        match (&self.message.properties, version) {
            (_, Version::V3) => {}
            (None, Version::V5) if ids.is_empty() => bytes.put_u8(0),
            (properties, Version::V5) => {
                let mut properties = properties.as_deref().cloned().unwrap_or_default();
                let left = |at: Instant| at.saturating_duration_since(now).as_secs_f64().ceil() as u32;
                properties.message_expiry_interval = self.message.expires.map(left);
                properties.subscription_identifiers = ids;
                // Encoding fails only for lengths that the decoder did not let in.
                let _ = properties.write(&mut bytes);
            }
        }
        bytes
    }
}
