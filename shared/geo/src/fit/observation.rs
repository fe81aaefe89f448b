//! What a fit is made from: positions in the reconstruction whose place on the earth is known.

use glam::DVec3;

use crate::similarity::Similarity;

/// A position of a reconstruction, and where it is on the earth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// In the frame of the reconstruction.
    pub model: DVec3,
    /// ENU of the site, metres.
    pub enu_m: DVec3,
    /// Whether the height is known; otherwise `enu_m.z` does not count.
    pub has_height: bool,
    /// Standard deviations of the place, horizontal and vertical, metres, above 0: those that its receiver tells, or else
    /// the least ones. The residuals may tell that they are larger.
    pub sigma_m: [f64; 2],
    /// Whether its receiver tells them.
    pub is_told: bool,
}

impl Sighting {
    /// Where the similarity puts the position, minus where it is: metres. Without a height, z is 0.
    pub(crate) fn residual(&self, similarity: &Similarity) -> DVec3 {
        let off = similarity.apply(self.model) - self.enu_m;
        if self.has_height { off } else { off.with_z(0.0) }
    }
}

/// The median, of an even number the larger of the two in the middle; 0 of nothing.
#[must_use]
pub fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
