//! Packets of MQTT 5 and MQTT 3.1.1 as bytes. Beyond this file every packet is one of MQTT 5.
//!
//! The codecs are those of rumqttc, which is linked anyway. Framing is shared with the client:
//! [`cosurf_link::mqtt::packet`].

#[cfg(test)]
mod fuzz;

use bytes::{BufMut, Bytes, BytesMut};
pub(super) use cosurf_link::mqtt::packet::packet_bytes;
use cosurf_link::mqtt::packet::{disconnect, read_packet, unless_panic};
use rumqttc::mqttbytes as old;
use rumqttc::mqttbytes::v4;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, Connect, ConnectProperties, ConnectReturnCode, DisconnectReasonCode, Filter, LastWill, Login,
    Packet, PubAck, PubComp, PubRec, PubRel, Publish, RetainForwardRule, SubAck, Subscribe,
    SubscribeReasonCode, UnsubAck, Unsubscribe,
};

/// A version of MQTT.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Version {
    /// MQTT 3.1.1.
    V3,
    /// MQTT 5.
    V5,
}

/// The first byte of DISCONNECT.
const DISCONNECT: u8 = 0xE0;
/// A session of MQTT 3.1.1 that is not clean never expires by itself.
const NEVER: u32 = u32::MAX;

/// Writes the remaining length of a packet; `length` must be below 2²⁸.
pub(super) fn put_length(out: &mut BytesMut, mut length: usize) {
    loop {
        let (byte, rest) = ((length % 128) as u8, length / 128);
        out.put_u8(if rest > 0 { byte | 0x80 } else { byte });
        if rest == 0 {
            return;
        }
        length = rest;
    }
}

/// The version that a CONNECT packet asks for; `None` if it is neither MQTT 5 nor MQTT 3.1.1, or no CONNECT at all.
pub(super) fn version_of(packet: &[u8]) -> Option<Version> {
    let header = 1 + packet.iter().skip(1).take_while(|byte| *byte & 0x80 != 0).count() + 1;
    match packet.get(header..header + 7) {
        Some([0, 4, b'M', b'Q', b'T', b'T', 5]) => Some(Version::V5),
        Some([0, 4, b'M', b'Q', b'T', b'T', 4]) => Some(Version::V3),
        _ => None,
    }
}

/// The first packet of a client.
#[derive(Debug)]
pub(super) struct Hello {
    pub(super) version: Version,
    pub(super) connect: Connect,
    pub(super) will: Option<LastWill>,
    pub(super) login: Option<Login>,
}

/// Reads a CONNECT packet; `None` if it is malformed.
pub(super) fn read_hello(packet: &[u8], version: Version) -> Option<Hello> {
    match read(packet, version).ok()? {
        Packet::Connect(connect, will, login) => Some(Hello { version, connect, will, login }),
        _ => None,
    }
}

/// Reads one whole packet.
pub(super) fn read(packet: &[u8], version: Version) -> Result<Packet, DisconnectReasonCode> {
    match version {
        Version::V5 => read_packet(packet),
        Version::V3 => {
            unless_panic(|| v4::Packet::read(&mut BytesMut::from(packet), usize::MAX)).and_then(modern)
        }
    }
}

/// A client's packet of MQTT 3.1.1 as one of MQTT 5.
fn modern(packet: v4::Packet) -> Result<Packet, DisconnectReasonCode> {
    Ok(match packet {
        v4::Packet::Connect(connect) => modern_connect(connect),
        v4::Packet::Publish(publish) => Packet::Publish(Publish {
            dup: publish.dup,
            qos: modern_qos(publish.qos),
            retain: publish.retain,
            topic: Bytes::from(publish.topic),
            pkid: publish.pkid,
            payload: publish.payload,
            properties: None,
        }),
        v4::Packet::PubAck(ack) => Packet::PubAck(PubAck::new(ack.pkid, None)),
        v4::Packet::PubRec(ack) => Packet::PubRec(PubRec::new(ack.pkid, None)),
        v4::Packet::PubRel(ack) => Packet::PubRel(PubRel::new(ack.pkid, None)),
        v4::Packet::PubComp(ack) => Packet::PubComp(PubComp::new(ack.pkid, None)),
        v4::Packet::Subscribe(subscribe) => {
            let filters = subscribe.filters.into_iter().map(|filter| Filter {
                path: filter.path,
                qos: modern_qos(filter.qos),
                nolocal: false,
                preserve_retain: false,
                retain_forward_rule: RetainForwardRule::OnEverySubscribe,
            });
            Packet::Subscribe(Subscribe {
                pkid: subscribe.pkid,
                filters: filters.collect(),
                properties: None,
            })
        }
        v4::Packet::Unsubscribe(unsubscribe) => Packet::Unsubscribe(Unsubscribe {
            pkid: unsubscribe.pkid,
            filters: unsubscribe.topics,
            properties: None,
        }),
        v4::Packet::PingReq => Packet::PingReq(rumqttc::v5::mqttbytes::v5::PingReq),
        v4::Packet::Disconnect => disconnect(DisconnectReasonCode::NormalDisconnection),
        _ => return Err(DisconnectReasonCode::ProtocolError),
    })
}

fn modern_connect(connect: v4::Connect) -> Packet {
    let will = connect.last_will.map(|will| LastWill {
        topic: Bytes::from(will.topic),
        message: will.message,
        qos: modern_qos(will.qos),
        retain: will.retain,
        properties: None,
    });
    let login = connect.login.map(|login| Login { username: login.username, password: login.password });
    let session_expiry_interval = (!connect.clean_session).then_some(NEVER);
    let modern = Connect {
        keep_alive: connect.keep_alive,
        client_id: connect.client_id,
        clean_start: connect.clean_session,
        properties: Some(ConnectProperties { session_expiry_interval, ..ConnectProperties::default() }),
    };
    Packet::Connect(modern, will, login)
}

fn modern_qos(qos: old::QoS) -> QoS {
    match qos {
        old::QoS::AtMostOnce => QoS::AtMostOnce,
        old::QoS::AtLeastOnce => QoS::AtLeastOnce,
        old::QoS::ExactlyOnce => QoS::ExactlyOnce,
    }
}

fn old_qos(qos: QoS) -> old::QoS {
    match qos {
        QoS::AtMostOnce => old::QoS::AtMostOnce,
        QoS::AtLeastOnce => old::QoS::AtLeastOnce,
        QoS::ExactlyOnce => old::QoS::ExactlyOnce,
    }
}

/// Writes an answer of the broker. In MQTT 3.1.1 there is no DISCONNECT from a broker, so nothing is written for it.
pub(super) fn write(packet: &Packet, version: Version, out: &mut BytesMut) {
    // Encoding fails only for packets that are too large; answers are small.
    let _ = match (packet, version) {
        // The codec writes a byte more than the length that it announces.
        (Packet::Disconnect(disconnect), Version::V5) => {
            out.put_slice(&[DISCONNECT, 2, disconnect.reason_code as u8, 0]);
            return;
        }
        (Packet::Disconnect(_), Version::V3) => return,
        (packet, Version::V5) => packet.write(out, None).map_err(drop),
        (packet, Version::V3) => old_packet(packet).write(out, usize::MAX).map_err(drop),
    };
}

/// An answer of the broker as a packet of MQTT 3.1.1.
fn old_packet(packet: &Packet) -> v4::Packet {
    match packet {
        Packet::ConnAck(ConnAck { session_present, code, .. }) => {
            v4::Packet::ConnAck(v4::ConnAck::new(old_code(*code), *session_present))
        }
        Packet::PubAck(ack) => v4::Packet::PubAck(v4::PubAck::new(ack.pkid)),
        Packet::PubRec(ack) => v4::Packet::PubRec(v4::PubRec::new(ack.pkid)),
        Packet::PubRel(ack) => v4::Packet::PubRel(v4::PubRel::new(ack.pkid)),
        Packet::PubComp(ack) => v4::Packet::PubComp(v4::PubComp::new(ack.pkid)),
        Packet::SubAck(SubAck { pkid, return_codes, .. }) => {
            let codes = return_codes.iter().map(|code| match code {
                SubscribeReasonCode::Success(qos) => v4::SubscribeReasonCode::Success(old_qos(*qos)),
                _ => v4::SubscribeReasonCode::Failure,
            });
            v4::Packet::SubAck(v4::SubAck::new(*pkid, codes.collect()))
        }
        Packet::UnsubAck(UnsubAck { pkid, .. }) => v4::Packet::UnsubAck(v4::UnsubAck::new(*pkid)),
        _ => v4::Packet::PingResp,
    }
}

fn old_code(code: ConnectReturnCode) -> v4::ConnectReturnCode {
    match code {
        ConnectReturnCode::Success => v4::ConnectReturnCode::Success,
        ConnectReturnCode::ClientIdentifierNotValid => v4::ConnectReturnCode::BadClientId,
        ConnectReturnCode::BadUserNamePassword => v4::ConnectReturnCode::BadUserNamePassword,
        ConnectReturnCode::NotAuthorized => v4::ConnectReturnCode::NotAuthorized,
        ConnectReturnCode::UnsupportedProtocolVersion => v4::ConnectReturnCode::RefusedProtocolVersion,
        _ => v4::ConnectReturnCode::ServiceUnavailable,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_length_of_a_packet_is_written_as_it_is_read() {
        let mut out = BytesMut::from(&[0x30][..]);
        put_length(&mut out, 321);
        assert_eq!(packet_bytes(&out, 1000), Ok(Some(324)));
    }

    #[test]
    fn a_farewell_has_the_length_that_it_announces() {
        let mut out = BytesMut::new();
        write(&disconnect(DisconnectReasonCode::QuotaExceeded), Version::V5, &mut out);
        assert_eq!(out[..], [0xE0, 2, 0x97, 0]);
    }
}
