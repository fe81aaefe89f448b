//! Consistent Overhead Byte Stuffing (Cheshire and Baker 1999): encodes any bytes as bytes without zeros.
//! The encoding is one byte longer, plus at most one byte for every 254 bytes.
//!
//! The crate `cobs` is not used: postcard depends on an old version of it, and the few lines here are less
//! code than a second version of the crate.

/// Upper bound on the encoded size of `len` bytes.
#[cfg(test)]
const fn encoded_max(len: usize) -> usize {
    len + 1 + len / 254
}

/// Writes the encoding of `bytes` to the start of `out`, and returns its size in bytes. `None` if `out` is
/// too small.
pub(crate) fn encode(bytes: &[u8], out: &mut [u8]) -> Option<usize> {
    let (mut code_at, mut used) = (0, 1);
    for (i, &byte) in bytes.iter().enumerate() {
        if byte != 0 {
            *out.get_mut(used)? = byte;
            used += 1;
        }
        let is_last = i + 1 == bytes.len();
        if byte == 0 || (used - code_at == 255 && !is_last) {
            *out.get_mut(code_at)? = (used - code_at) as u8;
            code_at = used;
            used += 1;
        }
    }
    *out.get_mut(code_at)? = (used - code_at) as u8;
    (used <= out.len()).then_some(used)
}

/// Decodes `bytes` in place, and returns the decoded size in bytes. `None` if `bytes` is not a valid
/// encoding.
pub(crate) fn decode_in_place(bytes: &mut [u8]) -> Option<usize> {
    let (mut read, mut written) = (0, 0);
    while read < bytes.len() {
        let code = usize::from(bytes[read]);
        let end = read + code;
        if code == 0 || end > bytes.len() || bytes[read + 1..end].contains(&0) {
            return None;
        }
        bytes.copy_within(read + 1..end, written);
        written += code - 1;
        read = end;
        if code < 255 && read < bytes.len() {
            bytes[written] = 0;
            written += 1;
        }
    }
    (!bytes.is_empty()).then_some(written)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::vec::Vec;

    use super::*;

    fn assert_round_trip(bytes: &[u8]) {
        let mut out = std::vec![0; encoded_max(bytes.len())];
        let used = encode(bytes, &mut out).unwrap();
        assert!(!out[..used].contains(&0));
        let back = decode_in_place(&mut out[..used]).unwrap();
        assert_eq!(&out[..back], bytes);
    }

    #[test]
    fn every_length_and_zero_position_round_trips() {
        for len in 0..600 {
            assert_round_trip(&std::vec![0; len]);
            assert_round_trip(&std::vec![1; len]);
            for zero in 0..len {
                let mut bytes: Vec<u8> = (0..len).map(|i| (i % 255 + 1) as u8).collect();
                bytes[zero] = 0;
                assert_round_trip(&bytes);
            }
        }
    }

    /// These examples are given in common descriptions of COBS.
    #[test]
    fn published_examples_encode_as_published() {
        let mut out = [0; 8];
        for (bytes, encoded) in [
            (&[][..], &[1][..]),
            (&[0], &[1, 1]),
            (&[0, 0], &[1, 1, 1]),
            (&[0x11, 0x22, 0, 0x33], &[3, 0x11, 0x22, 2, 0x33]),
            (&[0x11, 0, 0, 0], &[2, 0x11, 1, 1, 1]),
        ] {
            let used = encode(bytes, &mut out).unwrap();
            assert_eq!(&out[..used], encoded);
        }
    }

    #[test]
    fn invalid_encodings_are_refused() {
        for bad in [&mut [][..], &mut [0], &mut [3, 1], &mut [2, 0], &mut [1, 0]] {
            assert_eq!(decode_in_place(bad), None);
        }
        assert_eq!(encode(&[1, 2, 3], &mut [0; 3]), None);
    }
}
