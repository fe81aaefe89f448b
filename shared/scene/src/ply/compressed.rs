//! Reads the compressed PLY of SuperSplat and splat-transform: splats quantised within chunks of 256.
//!
//! Layout by the source of splat-transform (github.com/playcanvas/splat-transform, `src/lib/readers/decompress-ply.ts`):
//! the element `chunk` has the bounds of positions, log scales and, in newer files, colours; `vertex` has four 32-bit words
//! for each splat; `sh`, which may be missing, has a byte for each coefficient, in the order of the 3DGS PLY.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use super::header::{Element, Format, Header, Kind, Scalar};
use crate::error::Refusal;
use crate::parts::{Parts, Record};
use crate::splats::{SH_C0, sh_coefficients};
use crate::{SceneError, files};

/// Splats of a chunk.
const CHUNK: u64 = 256;
/// The words of a splat in the element `vertex`.
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Bounds of a chunk: least and greatest position, log scale and colour.
const BOUNDS: [&str; 18] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
];
/// Bounds without those of colours, which older files lack.
const BOUNDS_MIN: usize = 12;
/// Distance between two values of a coefficient's byte: bytes cover -4 to 4.
const SH_STEP: f32 = 8.0 / 256.0;

/// Whether a PLY file is compressed, by its header. A file that is no PLY is not.
pub(crate) fn is_compressed(path: &Path) -> Result<bool, SceneError> {
    let mut input = BufReader::new(files::open(path)?);
    let header = Header::read(&mut input).map_err(|refusal| refusal.of(path))?;
    let has_words = |element: &Element| element.name == "vertex" && element.column(WORDS[0]).is_some();
    Ok(header.elements.iter().any(has_words))
}

/// Number of splats and degree of their spherical harmonics, from the header.
pub(crate) fn size(path: &Path) -> Result<(usize, u32), SceneError> {
    let table = Tables::open(path).map_err(|refusal| refusal.of(path))?;
    Ok((table.splats as usize, table.sh_degree))
}

/// Reads splats into `parts`.
pub(crate) fn read_into(path: &Path, parts: &mut Parts) -> Result<(), SceneError> {
    read(path, parts).map_err(|refusal| refusal.of(path))
}

fn read(path: &Path, parts: &mut Parts) -> Result<(), Refusal> {
    let Tables { splats, sh_degree, origin, chunks, vertices, sh } = Tables::open(path)?;
    parts.begin(sh_degree, splats as usize, origin);
    let coefficients = sh_coefficients(sh_degree) - 1;
    let mut bytes = vec![0; 3 * coefficients];
    let (mut chunks, mut vertices) = (chunks.at(path)?, vertices.at(path)?);
    let mut sh = sh.map(|sh| sh.at(path)).transpose()?;
    let (mut bounds, mut words) = ([0; BOUNDS.len()], [0; WORDS.len()]);
    bounds[BOUNDS_MIN + 3..].fill(1.0f32.to_bits()); // colours reach from 0 to 1 where the file has no bounds of them
    for i in 0..splats {
        if i % CHUNK == 0 {
            chunks.row(&mut bounds)?;
        }
        vertices.row(&mut words)?;
        let mut record = Chunk(bounds.map(f32::from_bits)).splat(words);
        if let Some(sh) = &mut sh {
            sh.input.read_exact(&mut bytes)?;
            for (k, byte) in bytes.iter().enumerate() {
                let (channel, coefficient) = (k / coefficients, k % coefficients);
                record.sh[3 * (1 + coefficient) + channel] = coefficient_of(*byte);
            }
        }
        parts.add(&record);
    }
    Ok(())
}

/// The value of a coefficient's byte: the middle of its step, except for the first and the last.
fn coefficient_of(byte: u8) -> f32 {
    match byte {
        0 => -4.0,
        255 => 4.0,
        _ => (f32::from(byte) + 0.5) * SH_STEP - 4.0,
    }
}

/// Where the tables of a file are.
struct Tables {
    splats: u64,
    sh_degree: u32,
    origin: glam::DVec3,
    chunks: Table,
    vertices: Table,
    sh: Option<Table>,
}

/// Rows of one size.
struct Table {
    offset_bytes: u64,
    /// For each known column, its place in a row; columns of older files may be missing at the end.
    columns: Vec<usize>,
    row_words: usize,
}

impl Tables {
    fn open(path: &Path) -> Result<Self, Refusal> {
        let file = File::open(path)?;
        let file_bytes = file.metadata()?.len();
        let header = Header::read(&mut BufReader::new(file))?;
        if header.format != Format::Binary {
            return Err("is a compressed PLY in ascii; save it again as binary".into());
        }
        let (mut offset_bytes, mut chunks, mut vertices, mut sh) = (header.size_bytes, None, None, None);
        for element in &header.elements {
            let row_bytes = element.row_bytes_min(header.format);
            let end_bytes = u128::from(offset_bytes) + u128::from(element.count) * u128::from(row_bytes);
            if end_bytes > u128::from(file_bytes) {
                return Err(format!(
                    "claims {} rows of element {}, but is too short for them; the file was cut short or is forged",
                    element.count, element.name
                )
                .into());
            }
            match element.name.as_str() {
                "chunk" => {
                    chunks = Some((element.count, Table::of(element, &BOUNDS, Scalar::F32, offset_bytes)?))
                }
                "vertex" => {
                    vertices = Some((element.count, Table::of(element, &WORDS, Scalar::U32, offset_bytes)?))
                }
                "sh" => sh = Some((element, offset_bytes)),
                _ => {}
            }
            offset_bytes = end_bytes as u64;
        }
        let (chunk_count, chunks) = chunks.ok_or("has packed splats, but no element called chunk")?;
        let (splats, vertices) = vertices.ok_or("has no element called vertex")?;
        if chunks.columns.len() < BOUNDS_MIN || vertices.columns.len() < WORDS.len() {
            return Err("lacks properties of the compressed PLY of SuperSplat; export it again".into());
        }
        if chunk_count < splats.div_ceil(CHUNK) {
            return Err(format!(
                "has {chunk_count} chunks for {splats} splats; it was cut short or is forged"
            )
            .into());
        }
        let sh = sh.map(|(element, offset_bytes)| sh_table(element, splats, offset_bytes)).transpose()?;
        let (sh_degree, sh) = sh.map_or((0, None), |(degree, table)| (degree, Some(table)));
        Ok(Self { splats, sh_degree, origin: header.origin, chunks, vertices, sh })
    }
}

/// The table of the harmonics above degree 0, and their degree.
fn sh_table(element: &Element, splats: u64, offset_bytes: u64) -> Result<(u32, Table), Refusal> {
    let is_byte = |name: &str, kind: Kind| name.starts_with("f_rest_") && kind == Kind::One(Scalar::U8);
    let bytes = element.properties.len();
    let degree = (1..=3).find(|&degree| 3 * (sh_coefficients(degree) - 1) == bytes);
    match degree {
        Some(degree)
            if element.count == splats
                && element.properties.iter().all(|property| is_byte(&property.name, property.kind)) =>
        {
            Ok((degree, Table { offset_bytes, columns: Vec::new(), row_words: 0 }))
        }
        _ => {
            Err("its element sh does not have 9, 24 or 45 bytes f_rest_* for each splat; export it again"
                .into())
        }
    }
}

impl Table {
    /// The columns of a table whose values all have one type of four bytes.
    fn of(element: &Element, names: &[&str], scalar: Scalar, offset_bytes: u64) -> Result<Self, Refusal> {
        if element.properties.iter().any(|property| property.kind != Kind::One(scalar)) {
            let reason = format!("has properties of an unknown type in its element {}", element.name);
            return Err(reason.into());
        }
        let columns = names.iter().map_while(|name| element.column(name)).collect();
        Ok(Self { offset_bytes, columns, row_words: element.properties.len() })
    }

    fn at(self, path: &Path) -> Result<Reader, Refusal> {
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(self.offset_bytes))?;
        let words = vec![0; 4 * self.row_words];
        Ok(Reader { input: BufReader::new(file), bytes: words, columns: self.columns })
    }
}

/// Reads the rows of a table.
struct Reader {
    input: BufReader<File>,
    bytes: Vec<u8>,
    columns: Vec<usize>,
}

impl Reader {
    /// Reads the known columns of the next row; leaves the others.
    fn row(&mut self, row: &mut [u32]) -> Result<(), Refusal> {
        self.input.read_exact(&mut self.bytes)?;
        for (value, column) in row.iter_mut().zip(&self.columns) {
            *value = u32::from_le_bytes([0, 1, 2, 3].map(|byte| self.bytes[4 * column + byte]));
        }
        Ok(())
    }
}

/// The bounds of a chunk, in the order of [`BOUNDS`].
struct Chunk([f32; BOUNDS.len()]);

impl Chunk {
    fn splat(&self, [position, rotation, scale, color]: [u32; WORDS.len()]) -> Record {
        let within = |least: usize, shares: [f32; 3]| -> [f32; 3] {
            std::array::from_fn(|k| {
                let (low, high) = (self.0[least + k], self.0[least + 3 + k]);
                low * (1.0 - shares[k]) + high * shares[k]
            })
        };
        let [r, g, b, a] = [24, 16, 8, 0].map(|shift| share(color, shift, 8));
        let mut record = Record {
            mean: within(0, three_shares(position)),
            quat: rotation_of(rotation),
            log_scale: within(6, three_shares(scale)),
            opacity_logit: libm::logf(a / (1.0 - a)),
            ..Record::ZERO
        };
        record.sh[..3].copy_from_slice(&within(12, [r, g, b]).map(|value| (value - 0.5) / SH_C0));
        record
    }
}

/// The value of some bits of a word, from 0 to 1.
fn share(word: u32, shift: u32, bits: u32) -> f32 {
    let most = (1u32 << bits) - 1;
    (word >> shift & most) as f32 / most as f32
}

/// Eleven, ten and eleven bits.
fn three_shares(word: u32) -> [f32; 3] {
    [share(word, 21, 11), share(word, 11, 10), share(word, 0, 11)]
}

/// A quaternion wxyz: two bits tell the largest component, ten each tell the others, which are at most the root of a half.
fn rotation_of(word: u32) -> [f32; 4] {
    let others = [20, 10, 0].map(|shift| (share(word, shift, 10) - 0.5) * std::f32::consts::SQRT_2);
    let largest = (word >> 30) as usize;
    let mut quat = [0.0; 4];
    let places = (0..4).filter(|place| *place != largest);
    places.zip(others).for_each(|(place, value)| quat[place] = value);
    quat[largest] = (1.0 - others.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    quat
}

#[cfg(test)]
mod tests;
