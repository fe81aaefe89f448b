//! Models packed to be sent.

use cosurf_scene::{Camera, Splats};
use cosurf_wire::body::{BodyHead, BodyPlan};
use cosurf_wire::{BodyCodec, DeviceId, FrameId, MAX_CHUNK_BYTES, ModelHeader, ModelId, ModelKind, SiteId};

use crate::body::{BodyFault, body_hash};
use crate::codec::{First, check_body, model_to_body, plain_importance};
use crate::trust::Credentials;

/// A model ready to be sent.
#[derive(Clone, Debug)]
pub struct Offer {
    /// What is announced.
    pub header: ModelHeader,
    /// What is sent in chunks; its size and hash are those of the header.
    pub body: Vec<u8>,
}

impl Offer {
    /// Packs a model; `views` counts the pictures that taught it. Refuses what a receiver would refuse. What
    /// matters most is judged by [`plain_importance`]; who has rendered the model knows better.
    pub fn new(
        device: DeviceId,
        model: ModelId,
        kind: ModelKind,
        views: u32,
        splats: &Splats,
        cameras: &[Camera],
    ) -> Result<Self, BodyFault> {
        Self::from_body(
            device,
            model,
            kind,
            views,
            model_to_body(splats, cameras, First::Important(&plain_importance(splats)))?,
        )
    }

    /// The same from a body that is already packed.
    pub fn from_body(
        device: DeviceId,
        model: ModelId,
        kind: ModelKind,
        views: u32,
        body: Vec<u8>,
    ) -> Result<Self, BodyFault> {
        let BodyHead { splats, cameras, sh_degree, bounds, .. } = *BodyPlan::new(&body)?.head();
        let header = ModelHeader {
            device,
            model,
            kind,
            frame: FrameId::default(),
            codec: BodyCodec::Packed,
            sh_degree,
            splats,
            cameras,
            views,
            bounds,
            body_bytes: body.len() as u64,
            chunk_bytes: MAX_CHUNK_BYTES as u32,
            blake3: body_hash(&body),
            signature: None,
        };
        check_body(&header, &body)?;
        Ok(Self { header, body })
    }

    /// The same in its sender's frame, signed by its key where it has one.
    pub fn with(mut self, site: &SiteId, credentials: &Credentials) -> Self {
        self.header.frame = credentials.frame;
        self.header.signature = None;
        if let Some(key) = &credentials.key {
            key.sign(site, &mut self.header);
        }
        self
    }
}
