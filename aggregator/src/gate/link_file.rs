//! The links of all models, in a file: those of a few models are read at a time.

use std::path::Path;

use cosurf_scene::SceneError;

use super::adjust::Link;
use crate::scratch::{Record, Records};

/// Links in a file.
#[derive(Debug)]
pub(super) struct LinkFile {
    records: Records,
    known: Vec<([usize; 2], Record)>,
}

impl LinkFile {
    /// No links yet. The file lies in the folder `scratch`.
    pub(super) fn new(scratch: &Path) -> Result<Self, SceneError> {
        Ok(Self { records: Records::new(scratch)?, known: Vec::new() })
    }

    /// Appends links.
    pub(super) fn extend(&mut self, links: impl IntoIterator<Item = Link>) -> Result<(), SceneError> {
        for link in links {
            self.known.push((link.models, self.records.put(&link)?));
        }
        Ok(())
    }

    /// Forgets all links but those between models for which `wanted` holds; it gets the lower index first.
    pub(super) fn retain(&mut self, wanted: impl Fn([usize; 2]) -> bool) {
        self.known.retain(|([a, b], _)| wanted([*a.min(b), *a.max(b)]));
    }

    /// Reads the links between models for which `wanted` holds; it gets the lower index first.
    pub(super) fn read(&self, wanted: impl Fn([usize; 2]) -> bool) -> Result<Vec<Link>, SceneError> {
        let wanted = self.known.iter().filter(|([a, b], _)| wanted([*a.min(b), *a.max(b)]));
        wanted.map(|(_, record)| self.records.get(*record)).collect()
    }
}
