//! Packets: the encoding of a message on a serial line. The first byte is the length of the topic. The topic
//! and the payload follow.

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};

/// Size of the largest packet in bytes.
pub(super) const MAX_PACKET_BYTES: usize = 1 + MAX_TOPIC_BYTES + MAX_MESSAGE_BYTES;

/// Joins a topic and a payload to a packet.
pub(super) fn join_packet(topic: &str, payload: &[u8]) -> Vec<u8> {
    // The length fits a byte: the assertion below checks that topics are shorter than 256 bytes.
    let mut packet = vec![topic.len() as u8];
    packet.extend_from_slice(topic.as_bytes());
    packet.extend_from_slice(payload);
    packet
}

const _: () = assert!(MAX_TOPIC_BYTES <= u8::MAX as usize);

/// Splits a packet into topic and payload; `None` if it has no valid topic.
pub(super) fn split_packet(mut packet: Vec<u8>) -> Option<(String, Vec<u8>)> {
    let length = usize::from(*packet.first()?);
    let payload = (packet.len() > length).then(|| packet.split_off(1 + length))?;
    packet.remove(0);
    Some((String::from_utf8(packet).ok()?, payload))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_round_trips_and_a_truncated_one_is_refused() {
        let packet = join_packet("a/b", b"xyz");
        assert_eq!(split_packet(packet), Some(("a/b".to_owned(), b"xyz".to_vec())));
        assert_eq!(split_packet(join_packet("t", b"")), Some(("t".to_owned(), Vec::new())));
        for bad in [&b""[..], &[1], &[5, b'a'], &[1, 0xFF]] {
            assert_eq!(split_packet(bad.to_vec()), None);
        }
    }
}
