//! Lossless compression of a picture's pixels. Each value is predicted from its left, upper and
//! upper-left neighbours; the differences from the predictions are compressed with zstd level 1. The
//! prediction makes photographs from drones much smaller than zstd alone.

use std::io::{self, Read, Write};

use crate::Picture;

/// zstd's compression level. Higher levels save a few percent on photographs and take several times
/// as long.
const LEVEL: i32 = 1;

/// Upper bound on zstd's own memory, bytes: its window and tables take less than half of this at
/// level 1.
const ZSTD_BYTES: u64 = 4 << 20;

/// Upper bound on the bytes that packing or unpacking takes besides the raw picture.
pub(super) fn scratch_bytes(picture_bytes: u64) -> u64 {
    // Twice the picture, because noise does not compress, and the output's capacity grows by
    // doubling.
    2 * picture_bytes + ZSTD_BYTES
}

/// Compresses a picture.
pub(super) fn pack(picture: &Picture) -> io::Result<Vec<u8>> {
    let row_bytes = 3 * picture.size_px[0] as usize;
    let mut above = &vec![0; row_bytes][..];
    let mut differences = vec![0; row_bytes];
    let mut out = zstd::Encoder::new(Vec::new(), LEVEL)?;
    for row in picture.rgb.chunks_exact(row_bytes) {
        for i in 0..row_bytes {
            differences[i] = row[i].wrapping_sub(predict(row, above, i));
        }
        out.write_all(&differences)?;
        above = row;
    }
    let mut packed = out.finish()?;
    packed.shrink_to_fit();
    Ok(packed)
}

/// Decompresses a picture of `size_px`.
pub(super) fn unpack(packed: &[u8], size_px: [u32; 2]) -> io::Result<Picture> {
    let row_bytes = 3 * size_px[0] as usize;
    let mut rgb = vec![0; row_bytes * size_px[1] as usize];
    zstd::Decoder::with_buffer(packed)?.read_exact(&mut rgb)?;
    let zeros = vec![0; row_bytes];
    for y in 0..size_px[1] as usize {
        let (done, rest) = rgb.split_at_mut(y * row_bytes);
        let above = if y == 0 { &zeros } else { &done[(y - 1) * row_bytes..] };
        let row = &mut rest[..row_bytes];
        for i in 0..row_bytes {
            row[i] = row[i].wrapping_add(predict(row, above, i));
        }
    }
    Ok(Picture::new(size_px, rgb))
}

/// Predicts value `i` of `row` from its neighbours, as if the colour channel changed linearly between
/// pixels: the value to the left plus the value above, minus the value above and to the left. For the
/// first pixel of a row: the value above.
fn predict(row: &[u8], above: &[u8], i: usize) -> u8 {
    match i {
        0..3 => above[i],
        _ => row[i - 3].wrapping_add(above[i]).wrapping_sub(above[i - 3]),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn every_byte_survives_packing() {
        for size_px in [[1, 1], [1, 9], [9, 1], [40, 30]] {
            let n: u32 = 3 * size_px[0] * size_px[1];
            for step in [0, 1, 7, 2_654_435_761_u32] {
                let rgb = (0..n).map(|i| (i.wrapping_mul(step) >> (step & 24)) as u8).collect();
                let picture = Picture::new(size_px, rgb);
                let packed = pack(&picture).unwrap();
                assert_eq!(unpack(&packed, size_px).unwrap(), picture);
                assert!(packed.len() as u64 <= scratch_bytes(u64::from(n)));
            }
        }
    }
}
