//! The outline of a cell, an area of the map that one device observes: a polygon.

use glam::DVec2;

/// A polygon with at least three corners, in order around it. Its area may be zero: the cell of a single row of views
/// has no width.
#[derive(Clone, Debug, PartialEq)]
pub struct Outline(Vec<DVec2>);

impl Outline {
    /// The rectangle with these lowest and highest coordinates.
    pub fn rectangle([low, high]: [DVec2; 2]) -> Self {
        Self(vec![low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)])
    }

    /// The polygon with these corners, clockwise or counterclockwise; the last corner may repeat the first. `None` if
    /// there are fewer than three corners, or if a coordinate is not finite.
    pub fn polygon(corners: &[[f64; 2]]) -> Option<Self> {
        let mut corners: Vec<DVec2> = corners.iter().copied().map(DVec2::from_array).collect();
        if corners.len() > 1 && corners.first() == corners.last() {
            corners.pop();
        }
        (corners.len() >= 3 && corners.iter().all(|corner| corner.is_finite())).then_some(Self(corners))
    }

    /// The corners, in order around the polygon.
    pub fn corners(&self) -> &[DVec2] {
        &self.0
    }

    /// Lowest and highest coordinates of the polygon.
    pub fn bounds(&self) -> [DVec2; 2] {
        self.0
            .iter()
            .fold([DVec2::MAX, DVec2::MIN], |[low, high], corner| [low.min(*corner), high.max(*corner)])
    }

    /// The nearest point of the polygon: `at` itself if it lies inside or on the border.
    pub fn nearest(&self, at: DVec2) -> DVec2 {
        let borders = || self.0.iter().zip(self.0.iter().cycle().skip(1)).map(|(a, b)| on_border(*a, *b, at));
        if self.surrounds(at) || borders().any(|point| point == at) {
            return at;
        }
        let nearest = borders().min_by(|a, b| a.distance_squared(at).total_cmp(&b.distance_squared(at)));
        nearest.unwrap_or(at)
    }

    /// Whether a map position lies in the polygon after the polygon is grown on each side. `margin` is the growth as a
    /// share of the polygon's width and height.
    pub fn reaches(&self, at: DVec2, margin: f64) -> bool {
        let [low, high] = self.bounds();
        (at - self.nearest(at)).abs().cmple((high - low) * margin).all()
    }

    /// True if `at` lies inside: a ray from it crosses the border an odd number of times.
    fn surrounds(&self, at: DVec2) -> bool {
        let borders = self.0.iter().zip(self.0.iter().cycle().skip(1));
        let crosses = |(a, b): &(&DVec2, &DVec2)| {
            (a.y > at.y) != (b.y > at.y) && at.x < a.x + (b.x - a.x) * (at.y - a.y) / (b.y - a.y)
        };
        borders.filter(crosses).count() % 2 == 1
    }
}

/// The point on the line from `a` to `b` that is nearest to `at`. If the line is parallel to an axis and `at` lies on
/// it, the result is exactly `at`.
fn on_border(a: DVec2, b: DVec2, at: DVec2) -> DVec2 {
    let along = b - a;
    let (low, high) = (a.min(b), a.max(b));
    if along.x == 0.0 || along.y == 0.0 {
        return at.clamp(low, high);
    }
    let share = (at - a).dot(along) / along.length_squared();
    a + along * share.clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_nearest_point_is_found_inside_outside_and_in_a_notch() {
        let outline =
            Outline::polygon(&[[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]]).unwrap();
        for (at, nearest) in [
            ([1.0, 1.0], [1.0, 1.0]),
            ([2.0, -3.0], [2.0, 0.0]),
            ([5.0, 5.0], [4.0, 4.0]),
            ([2.0, 1.0], [2.0, 1.0]),
            ([0.0, 2.0], [0.0, 2.0]),
        ] {
            assert_eq!(outline.nearest(DVec2::from(at)), DVec2::from(nearest), "{at:?}");
        }
        let in_notch = DVec2::new(2.0, 2.3);
        let found = outline.nearest(in_notch);
        assert!((found.distance(in_notch) - 1.3 * 2.0 / 13f64.sqrt()).abs() < 1e-12, "{found}");
        assert_eq!(outline.bounds(), [DVec2::ZERO, DVec2::splat(4.0)]);
    }

    #[test]
    fn a_polygon_may_repeat_its_first_corner_and_needs_three_finite_ones() {
        let open = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];
        let closed = [open[0], open[1], open[2], open[0]];
        assert_eq!(Outline::polygon(&open), Outline::polygon(&closed));
        assert_eq!(Outline::polygon(&open[..2]), None);
        assert_eq!(Outline::polygon(&[[0.0, 0.0], [f64::NAN, 0.0], [0.0, 1.0]]), None);
    }

    #[test]
    fn a_rectangle_without_area_has_a_nearest_point() {
        let row = Outline::rectangle([DVec2::ZERO, DVec2::new(5.0, 0.0)]);
        assert_eq!(row.nearest(DVec2::new(3.0, 0.0)), DVec2::new(3.0, 0.0));
        assert_eq!(row.nearest(DVec2::new(7.0, 1.0)), DVec2::new(5.0, 0.0));
        assert_eq!(Outline::rectangle([DVec2::ONE; 2]).nearest(DVec2::ZERO), DVec2::ONE);
    }
}
