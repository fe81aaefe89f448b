//! Rotations as files of other tools write them: matrices of nine numbers.

use glam::{DMat3, DVec3};

/// How far the axes may deviate from unit length and right angles: the largest accepted entry of `RᵀR - I`, where `R` is the
/// rotation.
const TOLERANCE: f64 = 1e-3;

/// The matrix with these rows.
pub(crate) fn from_rows(m: &[f64; 9]) -> DMat3 {
    DMat3::from_cols(DVec3::new(m[0], m[3], m[6]), DVec3::new(m[1], m[4], m[7]), DVec3::new(m[2], m[5], m[8]))
}

/// Whether a matrix is a rotation, up to rounding in a file.
pub(crate) fn is_rotation(matrix: &DMat3) -> bool {
    let residual = matrix.transpose() * *matrix - DMat3::IDENTITY;
    residual.to_cols_array().iter().all(|value| value.abs() < TOLERANCE) && matrix.determinant() > 0.0
}
