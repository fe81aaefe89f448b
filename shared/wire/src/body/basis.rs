//! The basis of a model's view-dependent spherical-harmonics coefficients: their mean over the splats, and
//! their principal directions (orthonormal, in order of falling variance).
//!
//! A splat has m = 3 (sh_degree + 1)² - 3 such coefficients. A basis has these fields: `components` and
//! `wide` (`u8` each, see [`ShLayout`]), the quantisation step of all directions (`f32`), the mean (m
//! values, `f32`), and m directions (m values each, `i16` in units of 1/32767). Directions beyond
//! `components` are zero.

use super::bytes::{Reader, Writer};
use super::error::BodyError;
use super::limits::sh_rest;
use super::sh::ShLayout;

/// Largest magnitude accepted for a coefficient of the mean. Colours are 0 to 1, so the coefficients of
/// trained models are far smaller.
const MEAN_MAX: f32 = 1e6;
/// Largest quantisation step accepted.
const STEP_MAX: f32 = 1e6;

/// Encoded size of a basis in bytes.
pub const fn basis_bytes(sh_degree: u8) -> usize {
    let m = sh_rest(sh_degree);
    6 + 4 * m + 2 * m * m
}

/// Encodes a basis into `out`, which has exactly [`basis_bytes`] bytes. The shape of `mean` is `[m]`, that
/// of `directions` is `[components, m]`.
///
/// # Panics
/// If the lengths do not match.
pub fn write_basis(layout: ShLayout, step: f32, mean: &[f32], directions: &[i16], out: &mut [u8]) {
    assert_eq!(directions.len(), mean.len() * usize::from(layout.components), "length of the directions");
    let mut writer = Writer(out);
    writer.bytes([layout.components, layout.wide]);
    writer.f32s(&[step]);
    writer.f32s(mean);
    directions.iter().for_each(|v| writer.bytes(v.to_le_bytes()));
    writer.0.fill(0);
}

/// Decodes a basis. Writes the mean to `mean` (shape `[m]`) and the directions to `directions` (shape
/// `[m, m]`). Returns the layout and the quantisation step.
///
/// # Panics
/// If the lengths do not match the degree.
pub fn read_basis(
    sh_degree: u8,
    bytes: &[u8],
    mean: &mut [f32],
    directions: &mut [i16],
) -> Result<(ShLayout, f32), BodyError> {
    let m = sh_rest(sh_degree);
    assert_eq!(
        (bytes.len(), mean.len(), directions.len()),
        (basis_bytes(sh_degree), m, m * m),
        "lengths of a basis"
    );
    let mut reader = Reader(bytes);
    let [components, wide] = reader.bytes();
    let [step] = reader.f32s();
    mean.iter_mut().for_each(|v| *v = f32::from_le_bytes(reader.bytes()));
    directions.iter_mut().for_each(|v| *v = i16::from_le_bytes(reader.bytes()));
    // These comparisons are false for NaN.
    if !(mean.iter().all(|v| v.abs() <= MEAN_MAX) && step > 0.0 && step <= STEP_MAX) {
        return Err(BodyError::BadPack);
    }
    Ok((ShLayout { components, wide }.check(sh_degree)?, step))
}
