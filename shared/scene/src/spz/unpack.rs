//! From the bytes of SPZ's columns to splats in the axes of the 3DGS PLY.

use super::header::{Header, Version};
use super::steps::{AXIS_SIGNS, COLOR_SCALE, LOG_SCALE_MIN, LOG_SCALE_STEPS, SH_SIGNS};
use crate::parts::Record;

/// Turns the bytes of a splat into its values. Whatever the bytes are, the values can be rendered, except for the positions
/// of version 1.
pub(super) fn unpack(header: &Header, bytes: [&[u8]; 6]) -> Record {
    let [position, opacity, color, scale, quat, sh] = bytes;
    let opacity = (f32::from(opacity[0]) / 255.0).clamp(1.0 / 255.0, 254.0 / 255.0);
    let mut record = Record {
        mean: unpack_position(header, position),
        quat: unpack_quat(quat),
        log_scale: std::array::from_fn(|k| f32::from(scale[k]) / LOG_SCALE_STEPS + LOG_SCALE_MIN),
        opacity_logit: libm::logf(opacity / (1.0 - opacity)),
        ..Record::ZERO
    };
    record.sh[..3].iter_mut().zip(color).for_each(|(v, byte)| {
        *v = (f32::from(*byte) / 255.0 - 0.5) / COLOR_SCALE;
    });
    for (k, (v, byte)) in record.sh[3..].iter_mut().zip(sh).enumerate() {
        *v = (f32::from(*byte) - 128.0) / 128.0 * SH_SIGNS[1 + k / 3];
    }
    record
}

fn unpack_position(header: &Header, bytes: &[u8]) -> [f32; 3] {
    let unit = (1u32 << header.fraction_bits) as f32;
    std::array::from_fn(|k| {
        let value = match header.version {
            Version::V1 => half::f16::from_le_bytes([bytes[2 * k], bytes[2 * k + 1]]).to_f32(),
            _ => {
                let [a, b, c] = [0, 1, 2].map(|byte| bytes[3 * k + byte]);
                // The arithmetic shift extends the sign, which is in the highest of the three bytes.
                (i32::from_le_bytes([0, a, b, c]) >> 8) as f32 / unit
            }
        };
        value * AXIS_SIGNS[k]
    })
}

/// Unpacks a quaternion of four bytes (from version 3 on), or of a byte each for x, y and z, with a positive w. Returns wxyz
/// in the axes of the 3DGS PLY.
fn unpack_quat(bytes: &[u8]) -> [f32; 4] {
    let mut q = [0.0f32; 4];
    let dropped = match *bytes {
        [a, b, c, d] => {
            let mut bits = u32::from_le_bytes([a, b, c, d]);
            let largest = (bits >> 30) as usize;
            for i in (0..4).rev().filter(|i| *i != largest) {
                let size = (bits & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
                q[i] = if bits >> 9 & 1 == 1 { -size } else { size };
                bits >>= 10;
            }
            largest
        }
        _ => {
            (0..3).for_each(|i| q[i] = f32::from(bytes[i]) / 127.5 - 1.0);
            3
        }
    };
    let rest: f32 = q.iter().map(|v| v * v).sum();
    q[dropped] = (1.0 - rest).max(0.0).sqrt();
    let [x, y, z, w] = q;
    [w, x, y * AXIS_SIGNS[1], z * AXIS_SIGNS[2]]
}
