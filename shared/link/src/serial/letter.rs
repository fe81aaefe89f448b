//! A message as it crosses a serial line: the length of its topic in one byte, the topic, the payload.

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};

/// Bytes of the largest letter.
pub(super) const MAX_LETTER_BYTES: usize = 1 + MAX_TOPIC_BYTES + MAX_MESSAGE_BYTES;

/// Puts topic and payload into one.
pub(super) fn seal(topic: &str, payload: &[u8]) -> Vec<u8> {
    // Topics are shorter than 256 bytes; the assertion below holds them to that.
    let mut letter = vec![topic.len() as u8];
    letter.extend_from_slice(topic.as_bytes());
    letter.extend_from_slice(payload);
    letter
}

const _: () = assert!(MAX_TOPIC_BYTES <= u8::MAX as usize);

/// Takes topic and payload apart; `None` where there is no topic in it.
pub(super) fn open(mut letter: Vec<u8>) -> Option<(String, Vec<u8>)> {
    let length = usize::from(*letter.first()?);
    let payload = (letter.len() > length).then(|| letter.split_off(1 + length))?;
    letter.remove(0);
    Some((String::from_utf8(letter).ok()?, payload))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_letter_comes_back_and_a_short_one_is_none() {
        let letter = seal("a/b", b"xyz");
        assert_eq!(open(letter), Some(("a/b".to_owned(), b"xyz".to_vec())));
        assert_eq!(open(seal("t", b"")), Some(("t".to_owned(), Vec::new())));
        for bad in [&b""[..], &[1], &[5, b'a'], &[1, 0xFF]] {
            assert_eq!(open(bad.to_vec()), None);
        }
    }
}
