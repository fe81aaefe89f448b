//! From splats to the bytes of an SPZ file.

use std::io::{self, Write};

use flate2::Compression;
use flate2::write::GzEncoder;

use super::columns::V4_HEAD_BYTES;
use super::header::{COORDINATE_BITS, HEAD_BYTES, MAGIC, Version};
use super::steps::{AXIS_SIGNS, COLOR_SCALE, LOG_SCALE_MIN, LOG_SCALE_STEPS, SH_SIGNS};
use crate::Splats;

/// Largest number of fractional bits of a coordinate; far coordinates get fewer.
const FRACTION_BITS: u8 = 12;
/// Number of bits of a coefficient: first for the harmonics of degree 1, then for those of higher degrees.
const SH_BITS: [u32; 2] = [5, 4];
/// Level of zstd: its default.
const ZSTD_LEVEL: i32 = 3;

/// The largest number of fractional bits with which every coordinate fits; `None` if a coordinate is too large.
pub(super) fn fraction_bits(splats: &Splats) -> Option<u8> {
    let farthest = splats.means.iter().flatten().fold(0.0f32, |far, v| far.max(v.abs()));
    let most = ((1u32 << (COORDINATE_BITS - 1)) - 1) as f32;
    (0..=FRACTION_BITS).rev().find(|bits| farthest * (1u32 << bits) as f32 <= most)
}

/// Writes a file of version 2, 3 or 4.
pub(super) fn encode(
    mut out: impl Write,
    splats: &Splats,
    fraction_bits: u8,
    version: Version,
) -> io::Result<()> {
    let columns = columns(splats, fraction_bits, version);
    let mut head = head(splats, fraction_bits, version);
    if version < Version::V4 {
        let mut gzip = GzEncoder::new(out, Compression::default());
        gzip.write_all(&head)?;
        columns.iter().try_for_each(|column| gzip.write_all(column))?;
        return gzip.finish().map(drop);
    }
    let stored = columns.iter().filter(|column| !column.is_empty());
    let packed: Vec<Vec<u8>> =
        stored.clone().map(|column| compressed(column.as_slice())).collect::<io::Result<_>>()?;
    head[HEAD_BYTES - 1] = packed.len() as u8;
    out.write_all(&head)?;
    out.write_all(&V4_HEAD_BYTES.to_le_bytes())?; // offset of the table
    out.write_all(&[0; 12])?;
    for (column, packed) in stored.zip(&packed) {
        out.write_all(&(packed.len() as u64).to_le_bytes())?;
        out.write_all(&(column.len() as u64).to_le_bytes())?;
    }
    packed.iter().try_for_each(|packed| out.write_all(packed))
}

/// A column as a stream of zstd with a checksum.
fn compressed(column: &[u8]) -> io::Result<Vec<u8>> {
    let mut zstd = zstd::bulk::Compressor::new(ZSTD_LEVEL)?;
    zstd.include_checksum(true)?;
    zstd.compress(column)
}

fn head(splats: &Splats, fraction_bits: u8, version: Version) -> [u8; HEAD_BYTES] {
    let mut head = [0; HEAD_BYTES];
    head[..4].copy_from_slice(&MAGIC);
    head[4..8].copy_from_slice(&(version as u32).to_le_bytes());
    head[8..12].copy_from_slice(&(splats.len() as u32).to_le_bytes());
    head[12] = splats.sh_degree as u8;
    head[13] = fraction_bits;
    head
}

fn columns(splats: &Splats, fraction_bits: u8, version: Version) -> [Vec<u8>; 6] {
    let byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
    let per_unit = (1u32 << fraction_bits) as f32;
    let fixed = |value: f32, sign: f32| ((value * sign * per_unit).round() as i32).to_le_bytes();
    let position = |mean: &[f32; 3]| [0, 1, 2].map(|k| fixed(mean[k], AXIS_SIGNS[k]));
    let positions = splats.means.iter().flat_map(position).flat_map(|[a, b, c, _]| [a, b, c]);
    let opacities = splats.opacity_logits.iter().map(|logit| byte(255.0 / (1.0 + (-logit).exp())));
    let colors = (0..splats.len())
        .flat_map(|i| [0, 1, 2].map(|k| byte((splats.sh_of(i)[k] * COLOR_SCALE + 0.5) * 255.0)));
    let scales = splats.log_scales.iter().flatten().map(|v| byte((v - LOG_SCALE_MIN) * LOG_SCALE_STEPS));
    let quats = match version >= Version::V3 {
        true => splats.quats.iter().flat_map(|quat| pack_quat(*quat)).collect(),
        false => splats.quats.iter().flat_map(|quat| pack_quat_coarsely(*quat)).collect(),
    };
    let mut sh = Vec::with_capacity(splats.sh.len() - 3 * splats.len());
    for i in 0..splats.len() {
        for (k, values) in splats.sh_of(i).chunks_exact(3).enumerate().skip(1) {
            sh.extend(values.iter().map(|v| pack_sh(v * SH_SIGNS[k], SH_BITS[usize::from(k > 3)])));
        }
    }
    [positions.collect(), opacities.collect(), colors.collect(), scales.collect(), quats, sh]
}

/// Encodes the coefficient of a harmonic, -1 to 1, as a byte, rounded to the nearest of `2^bits` levels.
fn pack_sh(value: f32, bits: u32) -> u8 {
    let part = 1 << (8 - bits);
    let rounded = (value * 128.0).round() as i32 + 128;
    ((rounded + part / 2).div_euclid(part) * part).clamp(0, 255) as u8
}

/// A quaternion as xyzw in SPZ's axes, of length 1.
fn normalised([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    let length = (w * w + x * x + y * y + z * z).sqrt();
    [x, y * AXIS_SIGNS[1], z * AXIS_SIGNS[2], w].map(|v| v / length)
}

/// Packs a quaternion into 32 bits. From the highest bit down: the index of the largest component (two bits); then,
/// for each other component in the order xyzw, its sign relative to the largest (one bit) and its magnitude (nine
/// bits).
fn pack_quat(quat: [f32; 4]) -> [u8; 4] {
    let q = normalised(quat);
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let mut bits = largest as u32;
    for (_, v) in q.iter().enumerate().filter(|(i, _)| *i != largest) {
        let is_negative = (*v < 0.0) != (q[largest] < 0.0);
        let size = (v.abs() / std::f32::consts::FRAC_1_SQRT_2 * 511.0 + 0.5) as u32;
        bits = bits << 10 | u32::from(is_negative) << 9 | size.min(511);
    }
    bits.to_le_bytes()
}

/// Packs a quaternion as version 2 does: a byte each for x, y and z, of the two quaternions with this meaning that with a
/// positive w.
fn pack_quat_coarsely(quat: [f32; 4]) -> [u8; 3] {
    let [x, y, z, w] = normalised(quat);
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    [x, y, z].map(|v| ((v * sign + 1.0) * 127.5).round().clamp(0.0, 255.0) as u8)
}
