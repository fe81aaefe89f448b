//! The normal equations of a similarity: seven unknowns.

/// Rotation about east, north and up (radians), the logarithm of the scale, and east, north and up (metres).
pub(super) const UNKNOWNS: usize = 7;
/// A row or a solution.
pub(super) type Row = [f64; UNKNOWNS];

/// Sums of weighted equations `row · x = value`.
#[derive(Clone, Debug, Default)]
pub(super) struct Normal {
    matrix: [Row; UNKNOWNS],
    right: Row,
}

impl Normal {
    /// Adds an equation with this weight, the inverse of its variance.
    pub(super) fn add(&mut self, row: &Row, value: f64, weight: f64) {
        for i in 0..UNKNOWNS {
            for j in 0..UNKNOWNS {
                self.matrix[i][j] += weight * row[i] * row[j];
            }
            self.right[i] += weight * row[i] * value;
        }
    }

    /// The solution, and the covariance of the unknowns; `None` if the equations do not determine them.
    pub(super) fn solve(&self) -> Option<(Row, [Row; UNKNOWNS])> {
        let inverse = inverse(&self.matrix)?;
        let solution = inverse.map(|row| row.iter().zip(&self.right).map(|(a, b)| a * b).sum());
        Some((solution, inverse))
    }
}

/// By Gauss and Jordan with pivots, after the diagonal is scaled to 1.
fn inverse(matrix: &[Row; UNKNOWNS]) -> Option<[Row; UNKNOWNS]> {
    let scale: Row = std::array::from_fn(|i| matrix[i][i].sqrt());
    if scale.iter().any(|scale| !(scale.is_finite() && *scale > 0.0)) {
        return None;
    }
    let mut left: [Row; UNKNOWNS] =
        std::array::from_fn(|i| std::array::from_fn(|j| matrix[i][j] / (scale[i] * scale[j])));
    let mut right: [Row; UNKNOWNS] =
        std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for column in 0..UNKNOWNS {
        let largest =
            (column..UNKNOWNS).max_by(|&a, &b| left[a][column].abs().total_cmp(&left[b][column].abs()))?;
        // Of a matrix with ones in its diagonal, so small a pivot is rounding.
        if left[largest][column].abs() < 1e-12 {
            return None;
        }
        left.swap(column, largest);
        right.swap(column, largest);
        let pivot = left[column][column];
        (left[column], right[column]) = (left[column].map(|v| v / pivot), right[column].map(|v| v / pivot));
        let (pivot_left, pivot_right) = (left[column], right[column]);
        for row in (0..UNKNOWNS).filter(|&row| row != column) {
            let factor = left[row][column];
            for j in 0..UNKNOWNS {
                left[row][j] -= factor * pivot_left[j];
                right[row][j] -= factor * pivot_right[j];
            }
        }
    }
    Some(std::array::from_fn(|i| std::array::from_fn(|j| right[i][j] / (scale[i] * scale[j]))))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn equations_are_solved() {
        let wanted: Row = [1.0, -2.0, 3.0, 0.5, 100.0, -7.0, 0.25];
        let mut normal = Normal::default();
        for i in 0..20 {
            let row: Row =
                std::array::from_fn(|j| f64::from((i * 7 + j as i32 * 13 + i * i * (j as i32 + 1)) % 17 - 8));
            normal.add(&row, row.iter().zip(&wanted).map(|(a, b)| a * b).sum(), 2.0);
        }
        let (solution, covariance) = normal.solve().unwrap();
        for j in 0..UNKNOWNS {
            assert!((solution[j] - wanted[j]).abs() < 1e-9, "{solution:?}");
            assert!(covariance[j][j] > 0.0);
        }
    }

    #[test]
    fn too_few_equations_have_no_solution() {
        let mut normal = Normal::default();
        assert!(normal.solve().is_none());
        (0..6).for_each(|i| normal.add(&std::array::from_fn(|j| f64::from(i * 3 + j as i32)), 1.0, 1.0));
        assert!(normal.solve().is_none());
    }
}
