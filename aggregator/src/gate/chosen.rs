//! Chooses the cameras of each model whose pictures are compared. The choice depends on all models that share ground, so
//! that nobody can know it before the others have sent theirs: a model that is right only in chosen pictures would pass.

use cosurf_scene::Camera;

use super::extent::Extent;
use super::frames::Move;
use super::similarity::Similarity;

/// Chooses cameras of one model.
pub(super) struct Chooser(blake3::Hasher);

/// One for each model. Models far away do not change it.
pub(super) fn choosers(extents: &[Option<Extent>], moves: &[Option<Move>]) -> Vec<Chooser> {
    let similarity = |i: usize| moves[i].map_or(Similarity::IDENTITY, |by| by.by);
    let chooser = |i: usize| {
        let near = |j: &usize| match (&extents[i], &extents[*j]) {
            (Some(its), Some(other)) => its.meets(&similarity(i), other, &similarity(*j)),
            _ => i == *j,
        };
        let mut hashes: Vec<[u8; 32]> = (0..extents.len())
            .filter(near)
            .filter_map(|j| extents[j].as_ref().map(|extent| extent.model_blake3))
            .collect();
        hashes.sort_unstable();
        let mut hasher = blake3::Hasher::new();
        hashes.iter().for_each(|hash| _ = hasher.update(hash));
        Chooser(hasher)
    };
    (0..extents.len()).map(chooser).collect()
}

/// One for each of `count` models whose choice is always the same.
#[cfg(test)]
pub(super) fn fixed(count: usize) -> Vec<Chooser> {
    choosers(&vec![None; count], &vec![None; count])
}

impl Chooser {
    /// At most `count_max` of `cameras`: one of each of so many equally long parts of the list.
    pub(super) fn choose(&self, cameras: &[Camera], count_max: usize) -> Vec<Camera> {
        if cameras.len() <= count_max {
            return cameras.to_vec();
        }
        let mut drawn = self.0.finalize_xof();
        let one = |part: usize| {
            let [first, end] = [part, part + 1].map(|part| part * cameras.len() / count_max);
            let mut bytes = [0; 8];
            drawn.fill(&mut bytes);
            let at = (u64::from_le_bytes(bytes) % (end - first) as u64) as usize;
            cameras[first + at]
        };
        (0..count_max).map(one).collect()
    }
}

#[cfg(test)]
mod tests {
    use cosurf_link::Model;

    use super::*;
    use crate::testing::{above, ground};

    fn extent(west: f32, width: f32) -> Option<Extent> {
        Extent::of(&Model { splats: ground(west, west + width), cameras: Vec::new() })
    }

    /// Indices of the cameras that the first of some models shows.
    fn chosen(extents: &[Option<Extent>]) -> Vec<usize> {
        let cameras: Vec<Camera> = (0..80).map(|i| above(f64::from(i))).collect();
        let choosers = choosers(extents, &vec![None; extents.len()]);
        let of_first = choosers[0].choose(&cameras, 8);
        let index = |camera: &Camera| cameras.iter().position(|other| other == camera).unwrap_or_default();
        of_first.iter().map(index).collect()
    }

    #[test]
    fn models_that_share_ground_change_the_choice_and_models_far_away_do_not() {
        let [near, other_near, far] = [extent(5.0, 10.0), extent(5.0, 11.0), extent(500.0, 10.0)];
        let first = extent(0.0, 10.0);
        let found = chosen(&[first, near]);
        assert!(found.iter().enumerate().all(|(i, at)| at / 10 == i), "one of each part: {found:?}");
        assert_eq!(found, chosen(&[first, near, far]));
        assert_ne!(found, chosen(&[first, other_near]));
        assert_eq!(chosen(&[first, near, other_near]), chosen(&[first, other_near, near]), "in any order");
        assert_eq!(chosen(&[None]).len(), 8, "also of a model without splats");
    }

    #[test]
    fn all_of_a_few_cameras_are_chosen() {
        let cameras = [above(0.0), above(1.0)];
        assert_eq!(choosers(&[None], &[None])[0].choose(&cameras, 8), cameras);
    }
}
