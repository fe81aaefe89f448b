//! How far a model is believed.

/// How far the observations of a model are believed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trust {
    /// Factor on what every observation is worth, 0..=1.
    pub weight: f64,
    /// Number of pixels on a square of one world unit, above 0. A camera that claims more counts as if it had so many.
    pub pixels_max: f64,
}

impl Trust {
    /// For a model that nothing speaks against.
    pub const FULL: Self = Self { weight: 1.0, pixels_max: f64::INFINITY };
}
