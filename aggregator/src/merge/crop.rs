//! The part of a picture that shows a tile.

use cosurf_scene::{Camera, Frustum};
use glam::DVec2;
use serde::{Deserialize, Serialize};

/// Parts begin and end at multiples of this, px: the squares in which the renderer works.
const STEP_PX: u32 = 16;
/// Least width and height of a part, px, if the picture is as large.
const SIDE_MIN_PX: u32 = 32;
/// Share of the points that may lie left of a part, right of it, above it and below it. Single splats that float far
/// from the ground would otherwise make parts as large as whole pictures.
const OUTSIDE: f64 = 0.01;

/// What a camera shows of a tile.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Part {
    /// The camera of the part of the picture.
    pub(super) camera: Camera,
    /// Splats whose centres lie deeper than this along the optical axis are left out, world units: the ground of the tile
    /// ends before. A camera that looks sideways would otherwise see far behind the tile.
    pub(super) far: f64,
}

impl Part {
    pub(super) fn frustum(&self) -> Frustum {
        Frustum::new(&self.camera).up_to(self.far)
    }
}

/// The camera of the part of a picture that shows points at `places_px`, which lie in the picture of `camera`. `None`
/// without points.
pub(super) fn crop(camera: &Camera, places_px: &[DVec2]) -> Option<Camera> {
    if places_px.is_empty() {
        return None;
    }
    let span = |axis: usize| {
        let mut at: Vec<f64> = places_px.iter().map(|place_px| place_px[axis]).collect();
        at.sort_unstable_by(f64::total_cmp);
        let outside = (OUTSIDE * at.len() as f64) as usize;
        span(at[outside], at[at.len() - 1 - outside], camera.size_px[axis])
    };
    let [x, y] = [0, 1].map(span);
    let shift = DVec2::new(f64::from(x[0]), f64::from(y[0]));
    Some(Camera { center_px: camera.center_px - shift, size_px: [x[1] - x[0], y[1] - y[0]], ..*camera })
}

/// First pixel of a part that reaches from `low` to `high`, and the first one behind it, in a picture with this side.
fn span(low: f64, high: f64, side: u32) -> [u32; 2] {
    let (low, high) = (low.max(0.0), high.min(f64::from(side) - 0.5).max(0.0));
    let first = low as u32 / STEP_PX * STEP_PX;
    let behind = ((high as u32 / STEP_PX + 1) * STEP_PX).min(side);
    let short = SIDE_MIN_PX.saturating_sub(behind - first);
    let behind = (behind + short).min(side);
    [first.min(behind.saturating_sub(SIDE_MIN_PX) / STEP_PX * STEP_PX), behind]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::above;

    #[test]
    fn parts_are_whole_squares_and_stay_inside_the_picture() {
        assert_eq!(span(50.0, 90.0, 320), [48, 96]);
        assert_eq!(span(0.0, 319.9, 320), [0, 320]);
        assert_eq!(span(40.0, 41.0, 320), [32, 64], "not too narrow");
        assert_eq!(span(199.0, 199.5, 200), [160, 200], "at the border");
        assert_eq!(span(1.0, 2.0, 20), [0, 20], "a small picture");
    }

    #[test]
    fn a_part_shows_the_same_as_the_picture() {
        let camera = above(0.0).resized([480, 320]);
        let places_px: Vec<DVec2> = (0..300).map(|i| DVec2::new(100.0 + 0.2 * f64::from(i), 200.0)).collect();
        let part = crop(&camera, &places_px).expect("there are points");
        assert_eq!(part.size_px, [64, 32]);
        let shift = camera.center_px - part.center_px;
        assert_eq!(shift, DVec2::new(96.0, 192.0));
        let p_world = camera.unproject(DVec2::new(130.0, 210.0), 7.0);
        let off = part.project(p_world).map(|p_px| (p_px + shift).distance(DVec2::new(130.0, 210.0)));
        assert!(off.is_some_and(|off| off < 1e-9), "{off:?}");
        assert_eq!(crop(&camera, &[]), None);
    }

    #[test]
    fn single_points_far_away_do_not_make_a_part_larger() {
        let camera = above(0.0).resized([480, 320]);
        let mut places_px = vec![DVec2::new(100.0, 200.0); 200];
        places_px.push(DVec2::new(470.0, 10.0));
        assert_eq!(crop(&camera, &places_px).expect("there are points").size_px, [32, 32]);
    }
}
