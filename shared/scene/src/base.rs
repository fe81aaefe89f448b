//! A reduced model that stands in for the full model until the full model has arrived.

use crate::Splats;

/// Some of a model's splats, adjusted so that they approximate the whole model while the other splats
/// are missing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Base {
    /// Index of each splat in the full model, ascending.
    pub ids: Vec<u32>,
    /// The adjusted splats in the order of `ids`, with spherical harmonics of degree 0. Rotations are
    /// those of the full model.
    pub splats: Splats,
}

impl Base {
    /// The base of the model without the splats at the model's indices `removed` (ascending, unique):
    /// these splats are dropped from the base, and the other ids are renumbered.
    pub fn without(&self, removed: &[u32]) -> Self {
        let mut left = Self { ids: Vec::new(), splats: Splats::with_capacity(0, self.splats.sh_degree) };
        for (i, id) in self.ids.iter().enumerate() {
            if let Err(before) = removed.binary_search(id) {
                left.ids.push(id - before as u32);
                left.splats.push_from(&self.splats, i);
            }
        }
        left
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn removing_splats_drops_and_renumbers_their_ids() {
        let mut splats = Splats::with_capacity(4, 0);
        (0..4u8).for_each(|i| splats.push([f32::from(i); 3], [1.0; 4], [0.0; 3], 0.0, &[0.0; 3]));
        let base = Base { ids: vec![1, 4, 6, 9], splats };
        let left = base.without(&[0, 4, 5, 8]);
        assert_eq!(left.ids, [0, 3, 5]);
        assert_eq!(left.splats.means, [[0.0; 3], [2.0; 3], [3.0; 3]]);
        assert_eq!(base.without(&[]), base);
    }
}
