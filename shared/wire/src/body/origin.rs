//! The world position that the positions of a body's splats are relative to.

use super::bytes::{Reader, Writer};
use super::error::BodyError;

/// Encoded size of an origin in bytes.
pub const ORIGIN_BYTES: usize = 24;
/// Limit on the absolute value of each coordinate, world units: more than the size of the earth.
pub const ORIGIN_MAX: f64 = 1e8;

/// Encodes an origin.
pub fn encode_origin(origin: [f64; 3]) -> [u8; ORIGIN_BYTES] {
    let mut bytes = [0; ORIGIN_BYTES];
    Writer(&mut bytes).f64s(&origin);
    bytes
}

/// Decodes and checks an origin: each coordinate is finite and within [`ORIGIN_MAX`].
pub fn decode_origin(bytes: &[u8; ORIGIN_BYTES]) -> Result<[f64; 3], BodyError> {
    let origin: [f64; 3] = Reader(bytes).f64s();
    let is_sane = origin.iter().all(|v| v.abs() <= ORIGIN_MAX);
    is_sane.then_some(origin).ok_or(BodyError::BadPack)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn origins_on_earth_come_back_and_others_are_refused() {
        let utm = [500_000.0, -5_200_000.25, 400.0];
        assert_eq!(decode_origin(&encode_origin(utm)), Ok(utm));
        for bad in [f64::NAN, f64::INFINITY, -2e8] {
            assert_eq!(decode_origin(&encode_origin([0.0, bad, 0.0])), Err(BodyError::BadPack));
        }
    }
}
