//! Splats as SPZ (github.com/nianticlabs/spz), for viewers and other tools; ten times smaller than PLY. A file is a
//! gzip stream of a 16-byte header, then all positions, opacities, colours, scales, rotations and spherical
//! harmonics.
//!
//! Version 3 is written; versions 2 and 3 are read. SPZ's axes are right, up, back; those of the 3DGS PLY are right,
//! down, forward. So y and z change sign when a file is written or read, as in other converters. Viewers then show
//! the SPZ like the PLY.
//!
//! The format is lossy: use it for viewing models, not for keeping them. Its steps are 0.24 mm for coordinates below
//! 2 km, 6 % for scales, and 0.1° for rotations (1° in version 2). Spherical harmonics have 4 or 5 bits.
//!
//! ```
//! use cosurf_scene::{Splats, spz};
//!
//! let mut splats = Splats::with_capacity(1, 0);
//! let (mean, quat, log_scale) = ([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0], [-4.0, -4.0, -6.0]);
//! splats.push(mean, quat, log_scale, 2.0, &[0.5, 0.0, -0.5]);
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("model.spz");
//! spz::write(&path, &splats)?;
//! let read = spz::read(&path)?;
//! assert_eq!(read.means, splats.means);
//! assert!((read.sh[0] - splats.sh[0]).abs() < 0.02);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#[cfg(test)]
mod tests;

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use crate::error::Refusal;
use crate::splats::sh_coefficients;
use crate::{SceneError, Splats, atomic};

const MAGIC: [u8; 4] = *b"NGSP";
const VERSION: u32 = 3;
const HEADER_BYTES: usize = 16;
/// Largest number of fractional bits of a coordinate; far coordinates get fewer.
const FRACTION_BITS: u8 = 12;
/// Bits of a coordinate, which is a signed fixed-point number.
const COORDINATE_BITS: u8 = 24;
/// A colour byte is `255 · (0.5 + COLOR_SCALE · sh[0])`. This also covers colours that cannot be displayed, because
/// higher harmonics may bring such a colour back into the displayable range.
const COLOR_SCALE: f32 = 0.15;
/// Number of bits of a coefficient: first for the harmonics of degree 1, then for those of higher degrees.
const SH_BITS: [u32; 2] = [5, 4];
/// Largest accepted ratio of uncompressed to compressed bytes; a file that claims more is refused as forged.
const RATIO_MAX: u64 = 32;
/// Factors between the coefficients in SPZ's axes and in those of the 3DGS PLY, by harmonic. A harmonic changes sign
/// if it is odd in y and z together.
const SH_SIGNS: [f32; 16] =
    [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];
/// Factors between the coordinates xyz in SPZ's axes and in those of the 3DGS PLY.
const AXIS_SIGNS: [f32; 3] = [1.0, -1.0, -1.0];

/// Writes `splats` as SPZ, atomically: after an error, an earlier file at `path` is unchanged. Errors: a coordinate
/// beyond ±8,388,607.
pub fn write(path: &Path, splats: &Splats) -> Result<(), SceneError> {
    let fraction_bits = fraction_bits(splats).ok_or_else(|| {
        SceneError::malformed(path, "SPZ cannot hold coordinates beyond 8,388,607; write a PLY instead")
    })?;
    atomic::write(path, |out| encode(out, splats, fraction_bits))
}

/// The bytes of an SPZ file with these splats; `None` if a coordinate is beyond ±8,388,607.
pub fn to_bytes(splats: &Splats) -> Option<Vec<u8>> {
    let fraction_bits = fraction_bits(splats)?;
    let mut bytes = Vec::new();
    encode(&mut bytes, splats, fraction_bits).ok()?;
    Some(bytes)
}

fn encode(out: impl Write, splats: &Splats, fraction_bits: u8) -> io::Result<()> {
    let mut gzip = GzEncoder::new(out, Compression::default());
    gzip.write_all(&header(splats, fraction_bits))?;
    gzip.write_all(&body(splats, fraction_bits))?;
    gzip.finish().map(|_| ())
}

/// The largest number of fractional bits with which every coordinate fits; `None` if a coordinate is too large.
fn fraction_bits(splats: &Splats) -> Option<u8> {
    let farthest = splats.means.iter().flatten().fold(0.0f32, |far, v| far.max(v.abs()));
    let most = ((1u32 << (COORDINATE_BITS - 1)) - 1) as f32;
    (0..=FRACTION_BITS).rev().find(|bits| farthest * (1u32 << bits) as f32 <= most)
}

fn header(splats: &Splats, fraction_bits: u8) -> [u8; HEADER_BYTES] {
    let mut header = [0; HEADER_BYTES];
    header[..4].copy_from_slice(&MAGIC);
    header[4..8].copy_from_slice(&VERSION.to_le_bytes());
    header[8..12].copy_from_slice(&(splats.len() as u32).to_le_bytes());
    header[12] = splats.sh_degree as u8;
    header[13] = fraction_bits;
    header
}

fn body(splats: &Splats, fraction_bits: u8) -> Vec<u8> {
    let byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
    let per_unit = (1u32 << fraction_bits) as f32;
    let mut body = Vec::with_capacity(splats.len() * body_bytes(splats.sh_degree));
    for mean in &splats.means {
        for (value, sign) in mean.iter().zip(AXIS_SIGNS) {
            body.extend_from_slice(&((value * sign * per_unit).round() as i32).to_le_bytes()[..3]);
        }
    }
    body.extend(splats.opacity_logits.iter().map(|logit| byte(255.0 / (1.0 + (-logit).exp()))));
    for i in 0..splats.len() {
        body.extend(splats.sh_of(i)[..3].iter().map(|v| byte((v * COLOR_SCALE + 0.5) * 255.0)));
    }
    body.extend(splats.log_scales.iter().flatten().map(|v| byte((v + 10.0) * 16.0)));
    splats.quats.iter().for_each(|quat| body.extend_from_slice(&pack_quat(*quat)));
    for i in 0..splats.len() {
        for (k, values) in splats.sh_of(i).chunks_exact(3).enumerate().skip(1) {
            body.extend(values.iter().map(|v| pack_sh(v * SH_SIGNS[k], SH_BITS[usize::from(k > 3)])));
        }
    }
    body
}

/// Encodes the coefficient of a harmonic, -1 to 1, as a byte, rounded to the nearest of `2^bits` levels.
fn pack_sh(value: f32, bits: u32) -> u8 {
    let part = 1 << (8 - bits);
    let rounded = (value * 128.0).round() as i32 + 128;
    ((rounded + part / 2).div_euclid(part) * part).clamp(0, 255) as u8
}

/// Packs a quaternion into 32 bits. From the highest bit down: the index of the largest component (two bits); then,
/// for each other component in the order xyzw, its sign relative to the largest (one bit) and its magnitude (nine
/// bits).
fn pack_quat([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let length = (w * w + x * x + y * y + z * z).sqrt();
    let q = [x, y * AXIS_SIGNS[1], z * AXIS_SIGNS[2], w].map(|v| v / length);
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let mut bits = largest as u32;
    for (_, v) in q.iter().enumerate().filter(|(i, _)| *i != largest) {
        let is_negative = (*v < 0.0) != (q[largest] < 0.0);
        let size = (v.abs() / std::f32::consts::FRAC_1_SQRT_2 * 511.0 + 0.5) as u32;
        bits = bits << 10 | u32::from(is_negative) << 9 | size.min(511);
    }
    bits.to_le_bytes()
}

/// Bytes of a splat before compression, in a file of version 3.
pub fn body_bytes(sh_degree: u32) -> usize {
    Header { quat_bytes: 4, splats: 1, sh_degree, fraction_bits: 0 }.body_bytes() as usize
}

/// Number of splats of a file and the degree of their spherical harmonics, from its header. Errors are those of [`read`],
/// except for a file that was cut short.
pub fn size(path: &Path) -> Result<(usize, u32), SceneError> {
    let (mut file, size) = opened(path)?;
    let header = read_header(&mut file, size).map_err(|refusal| refusal.of(path))?.1;
    Ok((header.splats, header.sh_degree))
}

/// Reads splats. Whatever the bytes of the file are, the values can be rendered ([`Splats::find_bad_value`]). The
/// number of splats is checked against the file's length before anything is allocated.
pub fn read(path: &Path) -> Result<Splats, SceneError> {
    let (file, size) = opened(path)?;
    read_stream(file, size).map_err(|refusal| refusal.of(path))
}

/// The open file, and its length, bytes.
fn opened(path: &Path) -> Result<(BufReader<File>, u64), SceneError> {
    let size = fs::metadata(path).map_err(|cause| SceneError::io(path, cause))?.len();
    let file = File::open(path).map_err(|cause| SceneError::io(path, cause))?;
    Ok((BufReader::new(file), size))
}

/// The stream of a file behind its header, and the header.
fn read_header<R: BufRead>(mut file: R, size: u64) -> Result<(GzDecoder<R>, Header), Refusal> {
    if file.fill_buf()?.starts_with(&MAGIC) {
        return Err("is SPZ of version 4 or later; export it as version 3 or as PLY".into());
    }
    let mut gzip = GzDecoder::new(file);
    let mut header = [0; HEADER_BYTES];
    let not_spz = |_| "is not an SPZ file: it holds no gzip stream with an SPZ header";
    gzip.read_exact(&mut header).map_err(not_spz)?;
    let header = Header::parse(header)?;
    let bytes = header.body_bytes();
    if bytes > size.saturating_mul(RATIO_MAX) {
        return Err(format!(
            "claims {} splats, which a file of {size} bytes cannot hold; it was cut short or is forged",
            header.splats
        )
        .into());
    }
    Ok((gzip, header))
}

fn read_stream(file: impl BufRead, size: u64) -> Result<Splats, Refusal> {
    let (gzip, header) = read_header(file, size)?;
    let bytes = header.body_bytes();
    let mut body = Vec::new();
    let too_large = |_| format!("has {} splats, too many for this computer's memory", header.splats);
    body.try_reserve_exact(bytes as usize).map_err(too_large)?;
    gzip.take(bytes).read_to_end(&mut body)?;
    if body.len() as u64 != bytes {
        return Err(format!(
            "holds fewer than its {} splats; it was cut short, fetch it again",
            header.splats
        )
        .into());
    }
    Ok(header.splats_of(&body))
}

#[derive(Clone, Copy)]
struct Header {
    quat_bytes: usize,
    splats: usize,
    sh_degree: u32,
    fraction_bits: u8,
}

impl Header {
    fn parse(bytes: [u8; HEADER_BYTES]) -> Result<Self, Refusal> {
        let number = |at: usize| u32::from_le_bytes([0, 1, 2, 3].map(|i| bytes[at + i]));
        if bytes[..4] != MAGIC {
            return Err("is not an SPZ file: it does not begin with NGSP".into());
        }
        let quat_bytes = match number(4) {
            2 => 3,
            3 => 4,
            version => {
                return Err(
                    format!("is SPZ of version {version}; export it as version 2 or 3, or as PLY").into()
                );
            }
        };
        let (sh_degree, fraction_bits) = (u32::from(bytes[12]), bytes[13]);
        if sh_degree > 3 || fraction_bits >= COORDINATE_BITS {
            return Err("has spherical harmonics above degree 3, or coordinates without integer bits".into());
        }
        Ok(Self { quat_bytes, splats: number(8) as usize, sh_degree, fraction_bits })
    }

    /// Bytes per splat of the parts of the body: positions, opacities, colours, scales, rotations and spherical
    /// harmonics.
    fn parts(&self) -> [usize; 6] {
        [9, 1, 3, 3, self.quat_bytes, 3 * (sh_coefficients(self.sh_degree) - 1)]
    }

    fn body_bytes(&self) -> u64 {
        self.splats as u64 * self.parts().iter().sum::<usize>() as u64
    }

    fn splats_of(&self, body: &[u8]) -> Splats {
        let mut rest = body;
        let [positions, opacities, colors, scales, quats, sh] = self.parts().map(|bytes| {
            let (part, tail) = rest.split_at(bytes * self.splats);
            rest = tail;
            (part, bytes)
        });
        let of = |(part, bytes): (&'_ [u8], usize), i: usize| part[i * bytes..(i + 1) * bytes].to_vec();
        let mut splats = Splats::with_capacity(self.splats, self.sh_degree);
        let mut harmonics = vec![0.0; splats.sh_stride()];
        let unit = (1u32 << self.fraction_bits) as f32;
        for i in 0..self.splats {
            let position = of(positions, i);
            let mean = std::array::from_fn(|k| {
                let [a, b, c] = [0, 1, 2].map(|byte| position[3 * k + byte]);
                // The arithmetic shift extends the sign, which is in the highest of the three bytes.
                (i32::from_le_bytes([0, a, b, c]) >> 8) as f32 / unit * AXIS_SIGNS[k]
            });
            let opacity = (f32::from(of(opacities, i)[0]) / 255.0).clamp(1.0 / 255.0, 254.0 / 255.0);
            let color = of(colors, i);
            let scale = of(scales, i);
            harmonics[..3].iter_mut().zip(&color).for_each(|(v, byte)| {
                *v = (f32::from(*byte) / 255.0 - 0.5) / COLOR_SCALE;
            });
            for (k, (v, byte)) in harmonics[3..].iter_mut().zip(&of(sh, i)).enumerate() {
                *v = (f32::from(*byte) - 128.0) / 128.0 * SH_SIGNS[1 + k / 3];
            }
            let log_scale = std::array::from_fn(|k| f32::from(scale[k]) / 16.0 - 10.0);
            let logit = (opacity / (1.0 - opacity)).ln();
            splats.push(mean, unpack_quat(&of(quats, i)), log_scale, logit, &harmonics);
        }
        splats
    }
}

/// Unpacks a quaternion of version 3 (four bytes) or version 2 (a byte each for x, y and z, with a positive w).
/// Returns wxyz in the axes of the 3DGS PLY.
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
