//! The basis of a model's spherical harmonics beside the colour: their mean, and orthonormal directions in
//! which they vary, the greatest variance first.
//!
//! With m = 3 (sh_degree + 1)² - 3: components and wide (`u8` each, [`ShLayout`]), the step along every
//! direction as `f32`, the mean as m `f32`, and m directions of m `i16`, in units of 1/32767; those beyond
//! `components` are zero.

use super::bytes::{Reader, Writer};
use super::{BodyError, ShLayout, sh_rest};

/// Largest magnitude of a mean that is let in; colours are about 1.
const MEAN_MAX: f32 = 1e6;
/// Largest step that is let in.
const STEP_MAX: f32 = 1e6;

/// Bytes of a basis.
pub const fn basis_bytes(sh_degree: u8) -> usize {
    let m = sh_rest(sh_degree);
    6 + 4 * m + 2 * m * m
}

/// Writes a basis into exactly [`basis_bytes`]; `directions` holds as many as the layout keeps.
///
/// # Panics
/// Where the lengths do not belong together.
pub fn write_basis(layout: ShLayout, step: f32, mean: &[f32], directions: &[i16], out: &mut [u8]) {
    assert_eq!(directions.len(), mean.len() * usize::from(layout.components), "directions kept");
    let mut writer = Writer(out);
    writer.bytes([layout.components, layout.wide]);
    writer.f32s(&[step]);
    writer.f32s(mean);
    directions.iter().for_each(|v| writer.bytes(v.to_le_bytes()));
    writer.0.fill(0);
}

/// Reads a basis: its layout and step, its mean into `mean`, its directions into `directions`.
///
/// # Panics
/// Where the lengths do not belong to the degree.
pub fn read_basis(
    sh_degree: u8,
    bytes: &[u8],
    mean: &mut [f32],
    directions: &mut [i16],
) -> Result<(ShLayout, f32), BodyError> {
    let m = sh_rest(sh_degree);
    assert_eq!((bytes.len(), mean.len(), directions.len()), (basis_bytes(sh_degree), m, m * m), "a basis");
    let mut reader = Reader(bytes);
    let [components, wide] = reader.bytes();
    let [step] = reader.f32s();
    mean.iter_mut().for_each(|v| *v = f32::from_le_bytes(reader.bytes()));
    directions.iter_mut().for_each(|v| *v = i16::from_le_bytes(reader.bytes()));
    // Phrased so that NaN fails.
    if !(mean.iter().all(|v| v.abs() <= MEAN_MAX) && step > 0.0 && step <= STEP_MAX) {
        return Err(BodyError::BadPack);
    }
    Ok((ShLayout { components, wide }.check(sh_degree)?, step))
}
