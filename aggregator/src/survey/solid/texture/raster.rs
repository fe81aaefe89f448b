//! Which texels a triangle covers.
//!
//! What it knows nothing about: colours; where the triangle lies in the world.

use glam::{DVec2, DVec3};

/// Twice the area of the smallest triangle that covers texels by their centres, square texels.
const AREA_LEAST: f64 = 1e-9;

/// Calls `visit` with each texel whose centre a triangle covers, as column and row, and the weights of the triangle's corners
/// at that centre. Coordinates are in texels, 0 and up. A triangle that covers no centre has the texel around its own middle.
pub(super) fn each_texel(corners: [DVec2; 3], mut visit: impl FnMut([usize; 2], DVec3)) {
    let [a, b, c] = corners;
    let area = (b - a).perp_dot(c - a);
    let mut is_any = false;
    if area.abs() >= AREA_LEAST {
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        // Centres are half a texel from the corner of theirs.
        let first = (low - 0.5).ceil().max(DVec2::ZERO).as_u64vec2();
        let last = (high - 0.5).floor();
        for y in first.y..(last.y + 1.0) as u64 {
            for x in first.x..(last.x + 1.0) as u64 {
                let at = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let of_b = (at - a).perp_dot(c - a) / area;
                let of_c = (b - a).perp_dot(at - a) / area;
                let weights = DVec3::new(1.0 - of_b - of_c, of_b, of_c);
                if weights.min_element() >= 0.0 {
                    visit([x as usize, y as usize], weights);
                    is_any = true;
                }
            }
        }
    }
    if !is_any {
        let middle = (a + b + c) / 3.0;
        visit([middle.x as usize, middle.y as usize], DVec3::splat(1.0 / 3.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_lead_back_to_the_centres_of_the_texels_inside() {
        let corners = [DVec2::new(2.0, 1.0), DVec2::new(2.0, 5.0), DVec2::new(6.0, 1.0)];
        let mut found = Vec::new();
        each_texel(corners, |texel, weights| {
            let at = corners[0] * weights.x + corners[1] * weights.y + corners[2] * weights.z;
            assert!(at.distance(DVec2::new(texel[0] as f64 + 0.5, texel[1] as f64 + 0.5)) < 1e-12);
            found.push(texel);
        });
        assert_eq!(found.len(), 10, "{found:?}");
        assert!(found.contains(&[2, 1]) && found.contains(&[5, 1]) && !found.contains(&[5, 2]));
    }

    #[test]
    fn triangles_between_centres_have_one_texel() {
        let small = [DVec2::new(3.6, 7.6), DVec2::new(3.9, 7.6), DVec2::new(3.9, 7.8)];
        for corners in [small, [DVec2::new(3.7, 7.2); 3]] {
            let mut found = Vec::new();
            each_texel(corners, |texel, _| found.push(texel));
            assert_eq!(found, [[3, 7]]);
        }
    }
}
