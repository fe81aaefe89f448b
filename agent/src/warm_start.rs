//! Warm start: training starts from an earlier model of the ground in the pictures, for example from the last flight's
//! global model, instead of from the sparse cloud.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;
use std::path::Path;

use cosurf_link::plain_importance;
use cosurf_scene::{Camera, LocalFrame, SceneError, Splats, Watchers, model};
use glam::DVec3;

/// Number of splats of the file that are in memory at a time.
const PART: usize = 4096;

/// The splats of a model that cameras see.
#[derive(Clone, Debug, PartialEq)]
pub struct VisibleSplats {
    /// All of them, or as many as were asked for.
    pub splats: Splats,
    /// How many there are.
    pub count: usize,
}

/// Reads a model into the frame of `cameras` and keeps the splats whose centres at least one of `cameras` sees, in the
/// order of the file. If more than `splats_max` remain, keeps the most important ones, by opacity times area. The result
/// has spherical harmonics up to `sh_degree`: higher degrees of the file are dropped, and degrees that the file lacks are
/// zero. The memory does not grow with the file: it is read twice, first to choose splats and then to copy them.
pub fn read_visible_splats(
    path: &Path,
    frame: &LocalFrame,
    cameras: &[Camera],
    splats_max: usize,
    sh_degree: u32,
) -> Result<VisibleSplats, SceneError> {
    let mut choice = Choice::new(splats_max);
    let mut watchers = Watchers::new(cameras);
    model::read_parts(path, frame, PART, |part| choice.look_at(part, &mut watchers))?;
    let count = choice.visible;
    let mut extract = Extract::of(choice, sh_degree);
    model::read_parts(path, frame, PART, |part| extract.take_from(part))?;
    Ok(VisibleSplats { splats: extract.kept, count })
}

/// A splat's claim to be kept: its importance, then its place in the file; of equally important ones, the first is kept.
#[derive(Clone, Copy, PartialEq)]
struct Claim {
    importance: f32,
    place: usize,
}

impl Eq for Claim {}

impl Ord for Claim {
    fn cmp(&self, other: &Self) -> Ordering {
        self.importance.total_cmp(&other.importance).then(other.place.cmp(&self.place))
    }
}

impl PartialOrd for Claim {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The splats with the strongest claims among those that were looked at.
struct Choice {
    splats_max: usize,
    looked_at: usize,
    visible: usize,
    /// The weakest claim is on top.
    chosen: BinaryHeap<Reverse<Claim>>,
}

impl Choice {
    fn new(splats_max: usize) -> Self {
        Self { splats_max, looked_at: 0, visible: 0, chosen: BinaryHeap::new() }
    }

    fn look_at(&mut self, part: &Splats, watchers: &mut Watchers) {
        let importance = plain_importance(part);
        for (i, mean) in part.means.iter().enumerate() {
            let mean = DVec3::from_array(mean.map(f64::from));
            if !watchers.any(mean, |_| true) {
                continue;
            }
            self.visible += 1;
            self.chosen.push(Reverse(Claim { importance: importance[i], place: self.looked_at + i }));
            if self.chosen.len() > self.splats_max {
                self.chosen.pop();
            }
        }
        self.looked_at += part.len();
    }
}

/// Copies of the chosen splats.
struct Extract {
    /// Places of the chosen splats that are still to come, the next one last.
    left: Vec<usize>,
    passed: usize,
    kept: Splats,
    /// The spherical harmonics of one splat.
    sh: Vec<f32>,
}

impl Extract {
    fn of(choice: Choice, sh_degree: u32) -> Self {
        let mut left: Vec<usize> =
            choice.chosen.into_iter().map(|Reverse(Claim { place, .. })| place).collect();
        left.sort_unstable_by_key(|place| Reverse(*place));
        let kept = Splats::with_capacity(left.len(), sh_degree);
        let sh = vec![0.0; kept.sh_stride()];
        Self { left, passed: 0, kept, sh }
    }

    fn take_from(&mut self, part: &Splats) {
        let shared = self.sh.len().min(part.sh_stride());
        while let Some(i) = self.left.pop_if(|place| *place < self.passed + part.len()) {
            let i = i - self.passed;
            self.sh[..shared].copy_from_slice(&part.sh_of(i)[..shared]);
            self.kept.push(
                part.means[i],
                part.quats[i],
                part.log_scales[i],
                part.opacity_logits[i],
                &self.sh,
            );
        }
        self.passed += part.len();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Pose, ply};
    use glam::DVec2;

    use super::*;

    /// A camera 10 above the origin that looks down.
    fn above() -> Camera {
        Camera {
            cam_from_world: Pose::look_at(DVec3::Z * 10.0, DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(40.0),
            center_px: DVec2::new(24.0, 16.0),
            size_px: [48, 32],
        }
    }

    #[test]
    fn visible_splats_are_kept_the_most_important_first() {
        let mut model = Splats::with_capacity(4, 1);
        for (x, opacity_logit) in [(0.0, 1.0), (50.0, 9.0), (1.0, 3.0), (2.0, 2.0)] {
            let sh: Vec<f32> = (0..12).map(|k| x + k as f32).collect();
            model.push([x, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.0; 3], opacity_logit, &sh);
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.ply");
        ply::write(&path, &model, &LocalFrame::WORLD).unwrap();
        let read = |cameras: &[Camera], most, sh_degree| {
            read_visible_splats(&path, &LocalFrame::WORLD, cameras, most, sh_degree).unwrap()
        };
        assert_eq!(read(&[above()], 2, 3).count, 3);
        let kept = read(&[above()], 2, 3).splats;
        assert_eq!(kept.means, [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        assert_eq!((kept.sh_of(0)[11], kept.sh_of(0)[12], kept.sh_stride()), (12.0, 0.0, 48));
        assert_eq!(read(&[above()], 9, 0).splats.sh_of(2), [2.0, 3.0, 4.0]);
        assert!(read(&[], 9, 0).splats.is_empty());
        assert!(read(&[above()], 0, 0).splats.is_empty());
    }

    #[test]
    fn splats_are_chosen_from_all_parts_of_a_file() {
        let mut model = Splats::with_capacity(3 * PART, 0);
        for i in 0..2 * PART + 7 {
            let opacity_logit = if i % PART == 5 { 2.0 } else { 1.0 };
            model.push([i as f32 / 1e4, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.0; 3], opacity_logit, &[0.5; 3]);
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.ply");
        ply::write(&path, &model, &LocalFrame::WORLD).unwrap();
        let kept = read_visible_splats(&path, &LocalFrame::WORLD, &[above()], 5, 0).unwrap();
        let places = kept.splats.means.iter().map(|mean| (mean[0] * 1e4).round() as usize);
        assert_eq!(places.collect::<Vec<_>>(), [0, 1, 5, PART + 5, 2 * PART + 5]);
    }
}
