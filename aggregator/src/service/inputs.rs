//! The models that a merge gets, and how records name them.

use cosurf_wire::ModelHeader;
use serde::{Deserialize, Serialize};

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

    /// The inputs as records name them, in the order of device ids.
    pub(super) fn recorded(&self) -> Vec<Input> {
        let (whole, parts) = (self.whole.iter().map(Input::whole), self.parts.iter().map(Input::part));
        let mut recorded: Vec<Input> = whole.chain(parts).collect();
        recorded.sort_by(|one, other| one.device.cmp(&other.device));
        recorded
    }
}

/// A model that the service gave to a merge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Input {
    /// The device that sent the model.
    pub device: String,
    /// Number of the model.
    pub model: u64,
    /// BLAKE3 hash of the model's body.
    pub blake3: String,
    /// Number of splats that had arrived, if the model had arrived only in part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part_splats: Option<u32>,
}

impl Input {
    pub(super) fn whole(header: &ModelHeader) -> Self {
        let (device, blake3) = (header.device.to_string(), header.blake3.to_string());
        Self { device, model: header.model.0, blake3, part_splats: None }
    }

    pub(super) fn part(header: &ModelHeader) -> Self {
        Self { part_splats: Some(header.splats), ..Self::whole(header) }
    }
}
