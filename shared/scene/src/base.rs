//! A small model that stands in for a large one.

use crate::Splats;

/// Some splats of a model as they must be to stand in for all of them until the others are there.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Base {
    /// Which splats of the model, ascending.
    pub ids: Vec<u32>,
    /// What they are meanwhile, in the same order: of SH degree 0, and turned as in the model.
    pub splats: Splats,
}

impl Base {
    /// The base of what is left of the model without `removed`, ascending indices.
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
    fn it_stays_the_base_of_what_is_left() {
        let mut splats = Splats::with_capacity(4, 0);
        (0..4u8).for_each(|i| splats.push([f32::from(i); 3], [1.0; 4], [0.0; 3], 0.0, &[0.0; 3]));
        let base = Base { ids: vec![1, 4, 6, 9], splats };
        let left = base.without(&[0, 4, 5, 8]);
        assert_eq!(left.ids, [0, 3, 5]);
        assert_eq!(left.splats.means, [[0.0; 3], [2.0; 3], [3.0; 3]]);
        assert_eq!(base.without(&[]), base);
    }
}
