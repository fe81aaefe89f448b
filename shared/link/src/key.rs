//! The key of a model: its device and number.

use std::fmt;

use cosurf_wire::{DeviceId, ModelHeader, ModelId};

/// Identifies a model. The key is unique in a site.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ModelKey {
    /// The device that made the model.
    pub device: DeviceId,
    /// The model's number on that device.
    pub model: ModelId,
}

impl From<&ModelHeader> for ModelKey {
    fn from(header: &ModelHeader) -> Self {
        Self { device: header.device, model: header.model }
    }
}

impl From<ModelHeader> for ModelKey {
    fn from(header: ModelHeader) -> Self {
        Self::from(&header)
    }
}

impl fmt::Display for ModelKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.device, self.model)
    }
}
