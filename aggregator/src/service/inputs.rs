//! The models that a merge gets.

use cosurf_wire::ModelHeader;

/// The models to merge. Each list is in the order of device ids.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Inputs {
    /// Models that have arrived completely.
    pub(super) whole: Vec<ModelHeader>,
    /// Parts of models that have not arrived completely. Each part is a model of its own.
    pub(super) parts: Vec<ModelHeader>,
}

impl Inputs {
    pub(super) fn headers(&self) -> impl Iterator<Item = &ModelHeader> {
        self.whole.iter().chain(&self.parts)
    }
}
