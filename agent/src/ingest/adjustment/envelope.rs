//! Symmetric matrices whose rows begin with zeros: only what lies between the first other number of a row and the diagonal is
//! stored. Factors by Cholesky's method have the same shape (George and Liu, Computer Solution of Large Sparse Positive
//! Definite Systems, 1981, chapter 4).

/// The lower half of a symmetric matrix, or its factor.
pub(super) struct Envelope {
    /// Column of the first number of each row.
    first: Vec<usize>,
    /// Where each row begins in `values`; one more entry than rows.
    begin: Vec<usize>,
    values: Vec<f64>,
}

impl Envelope {
    /// Bytes of a matrix whose rows begin in these columns.
    pub(super) fn bytes(first: &[usize]) -> usize {
        let numbers: usize = first.iter().enumerate().map(|(row, first)| row + 1 - first).sum();
        numbers * size_of::<f64>()
    }

    /// Zeros, in rows that begin in these columns, at most in the diagonal.
    pub(super) fn new(first: Vec<usize>) -> Self {
        let mut begin = vec![0];
        for (row, first) in first.iter().enumerate() {
            begin.push(begin[row] + row + 1 - first);
        }
        let values = vec![0.0; begin[first.len()]];
        Self { first, begin, values }
    }

    /// The numbers of a row from a column on, which must not lie before its first.
    pub(super) fn row_from(&mut self, row: usize, column: usize) -> &mut [f64] {
        let from = self.begin[row] + column - self.first[row];
        &mut self.values[from..self.begin[row + 1]]
    }

    /// The diagonal's number of a row.
    pub(super) fn diagonal(&mut self, row: usize) -> &mut f64 {
        &mut self.values[self.begin[row + 1] - 1]
    }

    /// Replaces the matrix by its factor. `None` if it is not positive definite.
    pub(super) fn factor(mut self) -> Option<Factor> {
        for row in 0..self.first.len() {
            let (above, values) = self.values.split_at_mut(self.begin[row]);
            let values = &mut values[..self.begin[row + 1] - self.begin[row]];
            let first = self.first[row];
            for column in first..=row {
                // Both rows have numbers from here on.
                let from = first.max(self.first[column]);
                let (left, rest) = values.split_at_mut(column - first);
                let of_row = &left[from - first..];
                if column == row {
                    let square = rest[0] - dot(of_row, of_row);
                    if !(square > 0.0 && square.is_finite()) {
                        return None;
                    }
                    rest[0] = square.sqrt();
                } else {
                    let [begin, end] = [self.begin[column], self.begin[column + 1]];
                    let other = &above[begin + from - self.first[column]..end];
                    rest[0] = (rest[0] - dot(of_row, other)) / other[other.len() - 1];
                }
            }
        }
        Some(Factor(self))
    }
}

/// A lower triangle whose product with its transpose is the matrix.
pub(super) struct Factor(Envelope);

impl Factor {
    /// Solves `matrix · x = right` in place.
    pub(super) fn solve(&self, right: &mut [f64]) {
        let Envelope { first, begin, values } = &self.0;
        let row_of = |row: usize| values[begin[row]..begin[row + 1]].split_last();
        for row in 0..first.len() {
            if let Some((diagonal, left)) = row_of(row) {
                right[row] = (right[row] - dot(left, &right[first[row]..row])) / diagonal;
            }
        }
        for row in (0..first.len()).rev() {
            if let Some((diagonal, left)) = row_of(row) {
                right[row] /= diagonal;
                let value = right[row];
                right[first[row]..row].iter_mut().zip(left).for_each(|(x, l)| *x -= l * value);
            }
        }
    }
}

/// The sum of products over the length of `a`, in eight lanes that the processor adds at once.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let b = &b[..a.len()];
    let mut lanes = [0.0; 8];
    let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f64 = a8.remainder().iter().zip(b8.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a8.zip(b8) {
        for lane in 0..8 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    lanes.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Rows that begin in different columns, and a heavy diagonal.
    fn example() -> (Envelope, Vec<Vec<f64>>) {
        let first: Vec<usize> = (0..40_usize)
            .map(|row| if row > 36 { 0 } else { row.saturating_sub(3 + row * 7 % 11) })
            .collect();
        assert_eq!(
            Envelope::bytes(&first),
            8 * first.iter().enumerate().map(|(i, f)| i + 1 - f).sum::<usize>()
        );
        let mut matrix = Envelope::new(first.clone());
        let mut whole = vec![vec![0.0; 40]; 40];
        for row in 0..40 {
            for column in first[row]..=row {
                let value =
                    if row == column { 30.0 } else { f64::from((row * 5 + column * 3) as u32 % 7) - 3.0 };
                matrix.row_from(row, column)[0] = value;
                (whole[row][column], whole[column][row]) = (value, value);
            }
        }
        (matrix, whole)
    }

    #[test]
    fn equations_are_solved() {
        let (matrix, whole) = example();
        let wanted: Vec<f64> = (0..40).map(|i| f64::from(i * 13 % 17) - 8.0).collect();
        let mut x: Vec<f64> = whole.iter().map(|row| dot(row, &wanted)).collect();
        matrix.factor().unwrap().solve(&mut x);
        for (x, wanted) in x.iter().zip(&wanted) {
            assert!((x - wanted).abs() < 1e-9, "{x} {wanted}");
        }
    }

    #[test]
    fn matrices_that_are_not_positive_definite_are_refused() {
        let (mut matrix, _) = example();
        *matrix.diagonal(20) = 0.1;
        assert!(matrix.factor().is_none());
    }
}
