//! Keeps copies of a model out, before models are compared: several copies would outvote the others.

use cosurf_engine::Trust;
use cosurf_link::Model;

use super::doubt::Doubt;
use super::extent::Extent;
use crate::merge::{Locals, MergeError, ModelSize};

/// For each model, the index of the first model with the same splats and cameras: its own, unless it is a copy.
fn originals(extents: &[Option<Extent>]) -> Vec<usize> {
    let hash = |i: usize| extents[i].as_ref().map(|extent| extent.model_blake3);
    let original = |i: usize| (0..i).find(|j| hash(i).is_some() && hash(*j) == hash(i)).unwrap_or(i);
    (0..extents.len()).map(original).collect()
}

/// The models that are no copies.
pub(super) struct Kept<'a> {
    locals: &'a dyn Locals,
    /// See [`originals()`].
    originals: Vec<usize>,
    /// Index of each of these models among all.
    indices: Vec<usize>,
}

impl<'a> Kept<'a> {
    /// `extents` are those of all models.
    pub(super) fn of(locals: &'a dyn Locals, extents: &[Option<Extent>]) -> Self {
        let originals = originals(extents);
        let indices = (0..originals.len()).filter(|i| originals[*i] == *i).collect();
        Self { locals, originals, indices }
    }

    /// The extents of these models.
    pub(super) fn extents(&self, of_all: &[Option<Extent>]) -> Vec<Option<Extent>> {
        self.indices.iter().map(|i| of_all[*i]).collect()
    }

    /// Index of each of these models among all.
    pub(super) fn indices(&self) -> &[usize] {
        &self.indices
    }

    /// The doubt about each of all models, given that about each of these.
    pub(super) fn doubts(&self, of_these: Vec<Option<Doubt>>) -> Vec<Option<Doubt>> {
        let copy = |(i, original): (usize, &usize)| (i != *original).then_some(Doubt::Copy(*original));
        let mut doubts: Vec<Option<Doubt>> = self.originals.iter().enumerate().map(copy).collect();
        for (i, doubt) in self.indices.iter().zip(of_these) {
            doubts[*i] = doubt.map(|doubt| match doubt {
                Doubt::Contradicts(others) => {
                    Doubt::Contradicts(others.into_iter().map(|other| self.indices[other]).collect())
                }
                doubt => doubt,
            });
        }
        doubts
    }
}

impl Locals for Kept<'_> {
    fn count(&self) -> usize {
        self.indices.len()
    }

    fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
        self.locals.size(self.indices[index])
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        self.locals.load(self.indices[index])
    }

    fn is_compressed(&self, index: usize) -> bool {
        self.locals.is_compressed(self.indices[index])
    }

    fn is_placed(&self, index: usize) -> bool {
        self.locals.is_placed(self.indices[index])
    }

    fn trust(&self, index: usize) -> Trust {
        self.locals.trust(self.indices[index])
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::merge::InMemory;
    use crate::testing::model_at;

    #[test]
    fn copies_are_found_and_the_others_keep_their_indices() {
        let [west, east] = [model_at(0.0), model_at(1.0)];
        // Whoever sends somebody's splats with useless cameras must not take that model's place.
        let blind = Model { cameras: Vec::new(), ..west.clone() };
        let mut recoloured = west.clone();
        recoloured.splats.sh[0] += 1.0;
        let last = model_at(2.0);
        let locals = InMemory(vec![
            west.clone(),
            east.clone(),
            east,
            west,
            last.clone(),
            Model::default(),
            Model::default(),
            blind,
            recoloured,
        ]);
        let extents: Vec<Option<Extent>> = locals.0.iter().map(Extent::of).collect();
        let kept = Kept::of(&locals, &extents);
        assert_eq!(kept.indices(), [0, 1, 4, 5, 6, 7, 8], "what has no splats or differs is no copy");
        assert_eq!(kept.load(2).unwrap().splats, last.splats);
        let empty = Some(Doubt::Empty);
        let of_these =
            vec![None, None, Some(Doubt::Contradicts(vec![1, 2])), empty.clone(), empty.clone(), None, None];
        let expected = [
            None,
            None,
            Some(Doubt::Copy(1)),
            Some(Doubt::Copy(0)),
            Some(Doubt::Contradicts(vec![1, 4])),
            empty.clone(),
            empty,
            None,
            None,
        ];
        assert_eq!(kept.doubts(of_these), expected);
    }
}
