//! The sending half of the conversation.

use std::time::Duration;

use cosurf_wire::{DeviceId, RefusalReason, SiteId, TileId};

use crate::{ModelKey, Offer};

/// How far an offer has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UploadProgress {
    /// Chunks of the body.
    pub chunks: u32,
    /// Chunks that the slowest receiver is known to have.
    pub chunks_there: u32,
    /// Bytes of all messages published, repetitions included.
    pub bytes_sent: u64,
}

/// Offers one model until every receiver has it on its disk or refuses it.
#[derive(Debug)]
pub struct Uploader {
    offer: Offer,
}

impl Uploader {
    /// Offers a device's model to the aggregator.
    pub fn local(_site: SiteId, offer: Offer) -> Self {
        Self { offer }
    }

    /// Offers a global model to `receivers`.
    pub fn global(_site: SiteId, _tile: TileId, offer: Offer, _receivers: &[DeviceId]) -> Self {
        Self { offer }
    }

    /// Which model.
    pub fn key(&self) -> ModelKey {
        ModelKey { device: self.offer.header.device, model: self.offer.header.model }
    }

    /// How far it has come.
    pub fn progress(&self) -> UploadProgress {
        unimplemented!("lands soon")
    }

    /// Whether every receiver is done or has refused for good.
    pub fn is_finished(&self) -> bool {
        unimplemented!("lands soon")
    }

    /// Receivers that refused for good.
    pub fn refusals(&self) -> impl Iterator<Item = (DeviceId, RefusalReason)> {
        std::iter::empty()
    }

    /// When [`crate::Node::step`] should run next although nothing is heard.
    pub fn next_wakeup(&self) -> Option<Duration> {
        unimplemented!("lands soon")
    }
}
