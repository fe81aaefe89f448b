//! From splats to the bytes of an SPZ file.

use std::io::{self, Seek, SeekFrom, Write};

use flate2::Compression;
use flate2::write::GzEncoder;

use super::columns::V4_HEAD_BYTES;
use super::header::{COORDINATE_BITS, HEAD_BYTES, Header, MAGIC, Version};
use super::steps::{AXIS_SIGNS, COLOR_SCALE, LOG_SCALE_MIN, LOG_SCALE_STEPS, SH_SIGNS};
use crate::{SceneError, Splats};

/// Largest number of fractional bits of a coordinate; far coordinates get fewer.
const FRACTION_BITS: u8 = 12;
/// Number of bits of a coefficient: first for the harmonics of degree 1, then for those of higher degrees.
const SH_BITS: [u32; 2] = [5, 4];
/// Level of zstd: its default.
const ZSTD_LEVEL: i32 = 3;
/// Bytes that a compressor gets at a time. Its output depends on this number, which is therefore the same however a model is
/// divided into parts.
const CHUNK_BYTES: usize = 1 << 16;

/// Calls a function with the parts of a model, one after the other.
pub type Source<'a> = dyn Fn(&mut dyn FnMut(&Splats)) -> Result<(), SceneError> + 'a;

/// The head of a file, with the largest number of fractional bits with which every coordinate fits; `None` if a coordinate is
/// too large.
pub(super) fn header(
    sh_degree: u32,
    version: Version,
    source: &Source,
) -> Result<Option<Header>, SceneError> {
    let (mut splats, mut farthest) = (0, 0.0f32);
    source(&mut |part| {
        splats += part.len();
        farthest = part.means.iter().flatten().fold(farthest, |far, v| far.max(v.abs()));
    })?;
    let most = ((1u32 << (COORDINATE_BITS - 1)) - 1) as f32;
    let fraction_bits = (0..=FRACTION_BITS).rev().find(|bits| farthest * (1u32 << bits) as f32 <= most);
    let with = |fraction_bits| Header { version, splats, degree_in_file: sh_degree, fraction_bits };
    Ok(fraction_bits.map(with))
}

/// Writes a file of version 2, 3 or 4.
pub(super) fn encode(out: &mut (impl Write + Seek), header: &Header, source: &Source) -> io::Result<()> {
    if header.version == Version::V4 {
        encode_zstd(out, header, source)
    } else {
        encode_gzip(out, header, source)
    }
}

/// Writes the head and all columns as one stream.
fn encode_gzip(out: &mut impl Write, header: &Header, source: &Source) -> io::Result<()> {
    let mut gzip = GzEncoder::new(out, Compression::default());
    gzip.write_all(&head(header, 0))?;
    COLUMNS
        .iter()
        .enumerate()
        .try_for_each(|(k, column)| write_column(&mut gzip, header, k, *column, source))?;
    gzip.finish().map(drop)
}

/// Writes a table of sizes, then a stream for each column that is not empty. The sizes are known at the end, so the table is
/// written again then.
fn encode_zstd(out: &mut (impl Write + Seek), header: &Header, source: &Source) -> io::Result<()> {
    let sizes = header.columns().map(|bytes| bytes as u64 * header.splats as u64);
    let stored: Vec<usize> = (0..sizes.len()).filter(|k| sizes[*k] > 0).collect();
    out.write_all(&head(header, stored.len() as u8))?;
    out.write_all(&V4_HEAD_BYTES.to_le_bytes())?; // offset of the table
    out.write_all(&[0; 12])?;
    let table_at = out.stream_position()?;
    let mut table: Vec<[u64; 2]> = stored.iter().map(|k| [0, sizes[*k]]).collect();
    write_table(out, &table)?;
    for (k, [packed_bytes, _]) in stored.into_iter().zip(&mut table) {
        let begin = out.stream_position()?;
        let mut zstd = zstd::Encoder::new(&mut *out, ZSTD_LEVEL)?;
        zstd.include_checksum(true)?;
        zstd.set_pledged_src_size(Some(sizes[k]))?;
        write_column(&mut zstd, header, k, COLUMNS[k], source)?;
        zstd.finish()?;
        *packed_bytes = out.stream_position()? - begin;
    }
    out.seek(SeekFrom::Start(table_at))?;
    write_table(out, &table)
}

fn write_table(out: &mut impl Write, table: &[[u64; 2]]) -> io::Result<()> {
    table.iter().flatten().try_for_each(|bytes| out.write_all(&bytes.to_le_bytes()))
}

fn head(header: &Header, streams: u8) -> [u8; HEAD_BYTES] {
    let mut head = [0; HEAD_BYTES];
    head[..4].copy_from_slice(&MAGIC);
    head[4..8].copy_from_slice(&(header.version as u32).to_le_bytes());
    head[8..12].copy_from_slice(&(header.splats as u32).to_le_bytes());
    head[12] = header.degree_in_file as u8;
    head[13] = header.fraction_bits;
    head[HEAD_BYTES - 1] = streams;
    head
}

/// Appends the bytes that a column has for some splats.
type Column = fn(&Splats, &Header, &mut Vec<u8>);

/// The columns, in the order of the file.
const COLUMNS: [Column; 6] = [positions, opacities, colors, scales, quats, harmonics];

/// Writes column `k` of all splats.
fn write_column(
    out: &mut impl Write,
    header: &Header,
    k: usize,
    column: Column,
    source: &Source,
) -> io::Result<()> {
    let wanted_bytes = header.columns()[k] as u64 * header.splats as u64;
    if wanted_bytes == 0 {
        return Ok(());
    }
    let (mut bytes, mut written_bytes, mut written) = (Vec::new(), 0, Ok(()));
    source(&mut |part| {
        column(part, header, &mut bytes);
        let whole = bytes.len() / CHUNK_BYTES * CHUNK_BYTES;
        if written.is_ok() {
            written = bytes[..whole].chunks(CHUNK_BYTES).try_for_each(|chunk| out.write_all(chunk));
        }
        bytes.drain(..whole);
        written_bytes += whole as u64;
    })
    .map_err(io::Error::other)?;
    written?;
    out.write_all(&bytes)?;
    if written_bytes + bytes.len() as u64 != wanted_bytes {
        return Err(io::Error::other("the model changed while it was read; try again"));
    }
    Ok(())
}

fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

fn positions(splats: &Splats, header: &Header, out: &mut Vec<u8>) {
    let per_unit = (1u32 << header.fraction_bits) as f32;
    let fixed = |value: f32, sign: f32| ((value * sign * per_unit).round() as i32).to_le_bytes();
    let position = |mean: &[f32; 3]| [0, 1, 2].map(|k| fixed(mean[k], AXIS_SIGNS[k]));
    out.extend(splats.means.iter().flat_map(position).flat_map(|[a, b, c, _]| [a, b, c]));
}

fn opacities(splats: &Splats, _: &Header, out: &mut Vec<u8>) {
    out.extend(splats.opacity_logits.iter().map(|logit| byte(255.0 / (1.0 + libm::expf(-logit)))));
}

fn colors(splats: &Splats, _: &Header, out: &mut Vec<u8>) {
    let color = |i| [0, 1, 2].map(|k| byte((splats.sh_of(i)[k] * COLOR_SCALE + 0.5) * 255.0));
    out.extend((0..splats.len()).flat_map(color));
}

fn scales(splats: &Splats, _: &Header, out: &mut Vec<u8>) {
    out.extend(splats.log_scales.iter().flatten().map(|v| byte((v - LOG_SCALE_MIN) * LOG_SCALE_STEPS)));
}

fn quats(splats: &Splats, header: &Header, out: &mut Vec<u8>) {
    match header.version >= Version::V3 {
        true => out.extend(splats.quats.iter().flat_map(|quat| pack_quat(*quat))),
        false => out.extend(splats.quats.iter().flat_map(|quat| pack_quat_coarsely(*quat))),
    }
}

fn harmonics(splats: &Splats, _: &Header, out: &mut Vec<u8>) {
    for i in 0..splats.len() {
        for (k, values) in splats.sh_of(i).chunks_exact(3).enumerate().skip(1) {
            out.extend(values.iter().map(|v| pack_sh(v * SH_SIGNS[k], SH_BITS[usize::from(k > 3)])));
        }
    }
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
