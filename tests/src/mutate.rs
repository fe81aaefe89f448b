//! Changes samples at random, for fuzzing.

use crate::dice::Dice;

/// Values at the limits of integer fields, and infinity and NaN as `f32` and `f64`.
const EDGES: [u64; 16] = [
    0,
    1,
    2,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    0x7f80_0000,
    0x7fc0_0000,
    0x7ff0_0000_0000_0000,
    0x7fff_ffff_ffff_ffff,
    0xffff_ffff_ffff_ffff,
];
/// Maximum number of changes to one sample.
const CHANGES_MAX: usize = 6;
/// Largest size of a changed sample, bytes.
const BYTES_MAX: usize = 1 << 16;

/// One of `samples`, with 1 to 6 changes.
pub fn mutated(dice: &mut Dice, samples: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = samples[dice.below(samples.len())].clone();
    for _ in 0..1 + dice.below(CHANGES_MAX) {
        change(dice, &mut bytes, samples);
    }
    bytes.truncate(BYTES_MAX);
    bytes
}

fn change(dice: &mut Dice, bytes: &mut Vec<u8>, samples: &[Vec<u8>]) {
    let at = dice.below(bytes.len());
    match dice.below(8) {
        0 | 1 if !bytes.is_empty() => bytes[at] ^= 1 << dice.below(8),
        2 if !bytes.is_empty() => bytes[at] = dice.bits() as u8,
        3 | 4 => {
            let edge = EDGES[dice.below(EDGES.len())].to_le_bytes();
            let width = [1, 2, 4, 8][dice.below(4)];
            bytes.iter_mut().skip(at).zip(&edge[..width]).for_each(|(byte, edge)| *byte = *edge);
        }
        5 => bytes.truncate(at),
        6 => drop(bytes.drain(at..bytes.len().min(at + dice.below(32)))),
        _ => {
            let other = &samples[dice.below(samples.len())];
            let from = dice.below(other.len());
            let piece = &other[from..other.len().min(from + dice.below(64))];
            bytes.splice(at..at, piece.iter().copied());
        }
    }
}
