//! Packets of MQTT 5 as bytes, by the codec of rumqttc. Both the client and the aggregator's broker use this file: it
//! frames packets itself, so that no more bytes are kept than those of one packet, and works around what the codec
//! cannot read.

use std::panic::{AssertUnwindSafe, catch_unwind};

use bytes::BytesMut;
use rumqttc::v5::mqttbytes::v5::{Disconnect, DisconnectReasonCode, Packet};

/// The first byte of DISCONNECT.
const DISCONNECT: u8 = 0xE0;

/// Length of the first packet in `bytes`; `None` if its header has not arrived completely. An error if the packet is
/// larger than `bytes_max` or its length is malformed.
pub fn packet_bytes(bytes: &[u8], bytes_max: usize) -> Result<Option<usize>, DisconnectReasonCode> {
    let mut length = 0;
    for (place, byte) in bytes.iter().skip(1).take(4).enumerate() {
        length |= usize::from(byte & 0x7F) << (7 * place);
        if byte & 0x80 == 0 {
            let whole = 2 + place + length;
            return if whole > bytes_max {
                Err(DisconnectReasonCode::PacketTooLarge)
            } else {
                Ok(Some(whole))
            };
        }
    }
    if bytes.len() > 4 { Err(DisconnectReasonCode::MalformedPacket) } else { Ok(None) }
}

/// Reads one whole packet.
pub fn read_packet(packet: &[u8]) -> Result<Packet, DisconnectReasonCode> {
    // The codec reads neither of the short forms of DISCONNECT.
    match packet {
        [DISCONNECT, 0] => return Ok(disconnect(DisconnectReasonCode::NormalDisconnection)),
        [DISCONNECT, 1, reason] => {
            let reason = DisconnectReasonCode::try_from(*reason);
            return reason.map(disconnect).map_err(|_| DisconnectReasonCode::MalformedPacket);
        }
        _ => {}
    }
    let mut bytes = BytesMut::from(packet);
    unless_panic(|| Packet::read(&mut bytes, None))
}

/// Reads with a codec. A panic of the codec must not end the program, for what it reads comes from strangers.
pub fn unless_panic<T, E>(read: impl FnOnce() -> Result<T, E>) -> Result<T, DisconnectReasonCode> {
    let read = catch_unwind(AssertUnwindSafe(read));
    read.ok().and_then(Result::ok).ok_or(DisconnectReasonCode::MalformedPacket)
}

/// A DISCONNECT packet without properties.
pub fn disconnect(reason_code: DisconnectReasonCode) -> Packet {
    Packet::Disconnect(Disconnect { reason_code, properties: None })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_length_of_a_packet_is_known_from_its_header() {
        assert_eq!(packet_bytes(&[0x30], 100), Ok(None));
        assert_eq!(packet_bytes(&[0x30, 0x05], 100), Ok(Some(7)));
        assert_eq!(packet_bytes(&[0x30, 0x80], 1000), Ok(None));
        assert_eq!(packet_bytes(&[0x30, 0x80, 0x01], 1000), Ok(Some(131)));
        assert_eq!(packet_bytes(&[0x30, 0x80, 0x01], 130), Err(DisconnectReasonCode::PacketTooLarge));
        assert_eq!(
            packet_bytes(&[0x30, 0xFF, 0xFF, 0xFF, 0xFF], 9),
            Err(DisconnectReasonCode::MalformedPacket)
        );
    }

    #[test]
    fn every_form_of_disconnect_is_read() {
        for (bytes, reason) in [
            (&[0xE0, 0][..], DisconnectReasonCode::NormalDisconnection),
            (&[0xE0, 1, 4][..], DisconnectReasonCode::DisconnectWithWillMessage),
            (&[0xE0, 2, 4, 0][..], DisconnectReasonCode::DisconnectWithWillMessage),
        ] {
            assert_eq!(read_packet(bytes), Ok(disconnect(reason)), "{bytes:?}");
        }
    }

    /// Cut packets are malformed; the codec takes some of them for incomplete.
    #[test]
    fn a_packet_that_ends_too_early_is_malformed() {
        let packet = [0x32, 7, 0, 1, b'a', 0, 1, 0, b'x'];
        assert!(read_packet(&packet).is_ok());
        for length in 2..packet.len() - 1 {
            let mut cut = packet[..length].to_vec();
            cut[1] = (length - 2) as u8;
            assert_eq!(read_packet(&cut), Err(DisconnectReasonCode::MalformedPacket), "{length}");
        }
    }
}
