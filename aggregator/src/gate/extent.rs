//! Where a model lies, to find out quickly which models may share ground.

use cosurf_link::Model;
use glam::DVec3;

use super::similarity::Similarity;
use crate::merge::memory::rendered_bytes;
use crate::merge::{Locals, MergeError};

/// One splat in so many, along each axis and at each end, may lie outside the extent: a few splats may lie far off.
const OUTSIDE: usize = 50;
/// The extent is larger than the splats by this share of its longest side, because models may lie a little off.
const MARGIN: f64 = 0.25;

/// The extents of all models; `None` for models without splats. `is_given_up` is called between models; if it returns
/// true, the result is an error.
pub(super) fn extents(
    locals: &dyn Locals,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Vec<Option<Extent>>, MergeError> {
    let extent = |index: usize| match is_given_up() {
        true => Err(MergeError::GivenUp),
        false => Ok(Extent::of(&locals.load(index)?)),
    };
    (0..locals.count()).map(extent).collect()
}

/// Bytes that the largest of some models takes while pictures of it are rendered.
pub(super) fn held_bytes(extents: &[Option<Extent>]) -> u64 {
    extents.iter().flatten().map(|extent| extent.held_bytes).max().unwrap_or_default()
}

/// A box around most splats of a model, in the model's own frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extent {
    /// Bytes that the model takes while pictures of it are rendered.
    held_bytes: u64,
    /// Hash of all splats and cameras. Only a copy has the same.
    pub(super) model_blake3: [u8; 32],
    low: DVec3,
    high: DVec3,
}

impl Extent {
    /// The extent of a model; `None` without splats.
    pub(super) fn of(model: &Model) -> Option<Self> {
        let means = &model.splats.means;
        if means.is_empty() {
            return None;
        }
        let span = |axis: usize| {
            let mut at: Vec<f32> = means.iter().map(|mean| mean[axis]).collect();
            at.sort_unstable_by(f32::total_cmp);
            let outside = at.len() / OUTSIDE;
            [at[outside], at[at.len() - 1 - outside]].map(f64::from)
        };
        let [x, y, z] = [0, 1, 2].map(span);
        let (low, high) = (DVec3::new(x[0], y[0], z[0]), DVec3::new(x[1], y[1], z[1]));
        let margin = DVec3::splat(MARGIN * (high - low).max_element());
        let held_bytes = rendered_bytes(means.len(), model.splats.sh_degree);
        Some(Self { held_bytes, model_blake3: hash(model), low: low - margin, high: high + margin })
    }

    /// Whether the boxes of two models meet, if the models are moved by these similarities.
    pub(super) fn meets(&self, by: &Similarity, other: &Self, other_by: &Similarity) -> bool {
        let [one, other] = [self.moved(by), other.moved(other_by)];
        one.low.cmple(other.high).all() && other.low.cmple(one.high).all()
    }

    /// A box around the moved box.
    fn moved(&self, by: &Similarity) -> Self {
        let ends = [self.low, self.high];
        let corners = (0..8).map(|i| by.apply(DVec3::new(ends[i & 1].x, ends[i >> 1 & 1].y, ends[i >> 2].z)));
        let none = Self { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY, ..*self };
        corners.fold(none, |all, corner| Self { low: all.low.min(corner), high: all.high.max(corner), ..all })
    }
}

/// Hash of all numbers of a model. A model with the same splats and other cameras is no copy: it may be useless, and must not
/// take the place of the model that it was made from.
fn hash(model: &Model) -> [u8; 32] {
    let Model { splats, cameras } = model;
    let (mut hasher, mut row) = (blake3::Hasher::new(), Vec::new());
    for i in 0..splats.len() {
        row.clear();
        let numbers = [&splats.means[i][..], &splats.quats[i], &splats.log_scales[i], splats.sh_of(i)];
        let numbers = numbers.into_iter().flatten().chain([&splats.opacity_logits[i]]);
        numbers.for_each(|value| row.extend(value.to_le_bytes()));
        hasher.update(&row);
    }
    for camera in cameras {
        row.clear();
        camera.cam_from_world.bits().iter().for_each(|bits| row.extend(bits.to_le_bytes()));
        let intrinsics = [camera.focal_px, camera.center_px].map(|px| px.to_array());
        intrinsics.as_flattened().iter().for_each(|px| row.extend(px.to_le_bytes()));
        camera.size_px.iter().for_each(|side| row.extend(side.to_le_bytes()));
        hasher.update(&row);
    }
    *hasher.finalize().as_bytes()
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;
    use crate::testing::ground;

    fn extent(west: f32, east: f32) -> Extent {
        let mut splats = ground(west, east);
        splats.push([9000.0; 3], [1.0, 0.0, 0.0, 0.0], [0.0; 3], 1.0, &[0.5; 3]);
        Extent::of(&Model { splats, cameras: Vec::new() }).expect("it has splats")
    }

    #[test]
    fn neighbours_meet_and_models_far_apart_do_not_whatever_lies_far_off() {
        let [west, east, far] = [extent(-20.0, 2.0), extent(0.0, 20.0), extent(200.0, 220.0)];
        let same = Similarity::IDENTITY;
        assert!(west.meets(&same, &east, &same));
        assert!(!west.meets(&same, &far, &same) && !far.meets(&same, &east, &same));
        let back = Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation: -205.0 * DVec3::X };
        assert!(west.meets(&same, &far, &back));
        assert!(Extent::of(&Model::default()).is_none());
    }
}
