//! The model of Brown and Conrady with all the terms that Metashape and RealityCapture give it.

use glam::{DMat2, DVec2};

/// Rounds of Newton's method; a lens of a drone takes five.
const ROUNDS: usize = 50;
/// Largest error of a direction, on the plane at distance 1.
const ERROR_MAX: f64 = 1e-11;

/// How a lens bends the direction (x, y) on the plane at distance 1, with r² = x² + y²:
///
/// ```text
/// R = 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸      G = 1 + g1 r² + g2 r⁴
/// x' = x R + (p2 (r² + 2 x²) + 2 p1 x y) G
/// y' = y R + (p1 (r² + 2 y²) + 2 p2 x y) G
/// ```
///
/// The picture shows x' + skew y' and y'. The coefficients have no unit.
///
/// Source: manual of Metashape Professional 2.2, appendix *Camera models*, *Frame cameras*, in which P1 and P2 are p2 and
/// p1 here, and P3 and P4 are g1 and g2.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FullBrown {
    /// k1 to k4.
    pub radial: [f64; 4],
    /// p1 and p2, as OpenCV numbers them.
    pub tangential: [f64; 2],
    /// g1 and g2.
    pub growth: [f64; 2],
    /// The skew; Metashape's B2 / (f + B1).
    pub skew: f64,
}

impl FullBrown {
    pub(super) fn is_finite(&self) -> bool {
        let Self { radial, tangential, growth, skew } = self;
        radial.iter().chain(tangential).chain(growth).chain([skew]).all(|number| number.is_finite())
    }

    /// Where the picture shows a direction, and the derivative of that.
    pub(super) fn distort(&self, ray: DVec2) -> (DVec2, DMat2) {
        let Self { radial: [k1, k2, k3, k4], tangential: [p1, p2], growth: [g1, g2], skew } = *self;
        let (DVec2 { x, y }, r2) = (ray, ray.length_squared());
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        let growth = 1.0 + r2 * (g1 + r2 * g2);
        // Derivatives along r².
        let radial_slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4));
        let growth_slope = g1 + r2 * 2.0 * g2;
        let aside = DVec2::new(
            p2 * (r2 + 2.0 * x * x) + 2.0 * p1 * x * y,
            p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let mixed = 2.0 * (p1 * x + p2 * y);
        let aside_along_x = DVec2::new(6.0 * p2 * x + 2.0 * p1 * y, mixed);
        let aside_along_y = DVec2::new(mixed, 6.0 * p1 * y + 2.0 * p2 * x);
        let along = |axis: DVec2, along: f64, aside_along: DVec2| {
            axis * radial + 2.0 * along * (ray * radial_slope + aside * growth_slope) + aside_along * growth
        };
        let skewed = |v: DVec2| DVec2::new(v.x + skew * v.y, v.y);
        let slope = DMat2::from_cols(
            skewed(along(DVec2::X, x, aside_along_x)),
            skewed(along(DVec2::Y, y, aside_along_y)),
        );
        (skewed(ray * radial + aside * growth), slope)
    }

    /// The direction that the picture shows at a position, by Newton's method; `None` if it finds none, or one beyond a
    /// fold of the model.
    pub(super) fn ray(&self, shown: DVec2) -> Option<DVec2> {
        let mut ray = DVec2::new(shown.x - self.skew * shown.y, shown.y);
        for _ in 0..ROUNDS {
            let (is, slope) = self.distort(ray);
            if (is - shown).length() < ERROR_MAX {
                return (slope.determinant() > 0.0).then_some(ray);
            }
            ray -= slope.inverse() * (is - shown);
        }
        None
    }
}
