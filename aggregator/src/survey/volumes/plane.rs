//! A plane through heights, by least squares.
//!
//! What it knows nothing about: polygons.

use glam::{DMat2, DVec2};

/// Heights must spread at least this far across their longest direction, px, to tell how the plane leans.
const SPREAD_LEAST_PX: f64 = 1.0;

/// `height = middle height + slope · (position - middle)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Plane {
    middle: DVec2,
    height_m: f64,
    /// Metres per px.
    slope: DVec2,
}

impl Plane {
    /// The plane nearest to these heights: positions, px, and heights, metres. `None` if they lie on a line.
    pub(super) fn fitted(points: &[(DVec2, f64)]) -> Option<Self> {
        let count = points.len() as f64;
        let middle = points.iter().map(|(at, _)| *at).sum::<DVec2>() / count;
        let height_m = points.iter().map(|(_, height)| height).sum::<f64>() / count;
        let (mut squares, mut products) = (DMat2::ZERO, DVec2::ZERO);
        for (at, height) in points {
            let from = *at - middle;
            squares += DMat2::from_cols(from * from.x, from * from.y);
            products += from * (height - height_m);
        }
        // The determinant over the trace is about the smaller eigenvalue: the sum of squares across the line.
        let across = squares.determinant() / (squares.x_axis.x + squares.y_axis.y) / count;
        let is_told = across >= SPREAD_LEAST_PX * SPREAD_LEAST_PX; // false if there are no points
        is_told.then(|| Self { middle, height_m, slope: squares.inverse() * products })
    }

    /// Its height at a position, px.
    pub(super) fn height(&self, at: DVec2) -> f64 {
        self.height_m + self.slope.dot(at - self.middle)
    }

    /// Root mean square of the differences between heights and the plane.
    pub(super) fn rms(&self, points: &[(DVec2, f64)]) -> f64 {
        let squares: f64 = points.iter().map(|(at, height)| (height - self.height(*at)).powi(2)).sum();
        (squares / points.len() as f64).sqrt()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_plane_is_found_again_and_a_line_is_refused() {
        let at = |i: u32| DVec2::new(f64::from(i * i % 17), f64::from(i * 7 % 23));
        let height = |at: DVec2| 95.0 + 0.3 * at.x - 0.2 * at.y;
        let points: Vec<_> = (0..40).map(|i| (at(i), height(at(i)))).collect();
        let plane = Plane::fitted(&points).unwrap();
        assert!((plane.height(DVec2::new(100.0, -50.0)) - 135.0).abs() < 1e-9);
        assert!(plane.rms(&points) < 1e-9);
        let line: Vec<_> = (0..40).map(|i| (DVec2::new(1.0, 2.0) * f64::from(i), 1.0)).collect();
        assert_eq!([Plane::fitted(&line), Plane::fitted(&[])], [None, None]);
    }
}
