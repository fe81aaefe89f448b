//! Models packed for sending.

use cosurf_scene::{Camera, LocalFrame, Splats};
use cosurf_wire::body::{BodyHead, BodyPlan};
use cosurf_wire::{BodyCodec, DeviceId, FrameId, MAX_CHUNK_BYTES, ModelHeader, ModelId, ModelKind};

use crate::body::{BodyFault, body_hash};
use crate::codec::{FirstLayer, check_body, model_to_body, plain_importance};
use crate::manifest::Manifest;

/// A model packed for sending: its header and body.
#[derive(Clone, Debug)]
pub struct Offer {
    /// The header that announces the model.
    pub header: ModelHeader,
    /// The body, which is sent in chunks. The header has its size and hash.
    pub body: Vec<u8>,
}

/// Chunks of small bodies, bytes: what slow lines carry. Each break of a line loses half a chunk. A line of 5 kB/s that breaks
/// every second carries 1.3 to 1.5 times the body, with chunks of 2 KiB 1.4 to 2.0 times. Without breaks, a tenth of what it
/// carries are topics and headers.
const CHUNK_BYTES_SMALL: usize = 512;
/// Chunks of bodies of medium size, bytes. A line that carries such bodies is fast. Far away brokers acknowledge few
/// messages at a time, so small chunks would slow it down.
const CHUNK_BYTES: usize = 8 << 10;
/// Chunks become larger with the body from [`CHUNK_BYTES_SMALL`] to [`CHUNK_BYTES`], so that there are about so many.
const CHUNKS_SMALL: usize = 512;
/// A large body has larger chunks, so that it has no more than this number of them.
const CHUNKS: usize = 8192;

/// The size of a body's chunks, bytes.
fn chunk_bytes(body_bytes: usize) -> u32 {
    let chunks_of = |count: usize| body_bytes.div_ceil(count).next_power_of_two();
    let small = chunks_of(CHUNKS_SMALL).clamp(CHUNK_BYTES_SMALL, CHUNK_BYTES);
    chunks_of(CHUNKS).clamp(small, MAX_CHUNK_BYTES) as u32
}

impl Offer {
    /// Packs a model in the world's frame. `views` is the number of pictures that the model was trained on. Fails if a
    /// receiver would refuse the body. Importance is estimated by [`plain_importance`]. A caller that can measure
    /// importance by rendering should use [`Self::from_body`].
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
            model_to_body(
                splats,
                cameras,
                &LocalFrame::WORLD,
                FirstLayer::ByImportance(&plain_importance(splats)),
            )?,
        )
    }

    /// Makes an offer of a packed body. `views` is the number of pictures that the model was trained on.
    /// Fails if a receiver would refuse the body.
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
            chunk_bytes: chunk_bytes(body.len()),
            blake3: body_hash(&body),
        };
        check_body(&header, &body)?;
        Ok(Self { header, body })
    }

    /// Makes an offer of the list of a global model's tiles. `views` is the number of pictures that the model was trained
    /// on. Fails if a receiver would refuse the body.
    pub fn of_manifest(
        device: DeviceId,
        revision: ModelId,
        views: u32,
        manifest: &Manifest,
    ) -> Result<Self, BodyFault> {
        let body = manifest.encode();
        let header = ModelHeader {
            device,
            model: revision,
            kind: ModelKind::Manifest,
            frame: FrameId::default(),
            codec: BodyCodec::Packed,
            sh_degree: 0,
            splats: u32::try_from(manifest.splats()).unwrap_or(u32::MAX),
            cameras: 0,
            views,
            bounds: manifest.bounds(),
            body_bytes: body.len() as u64,
            chunk_bytes: chunk_bytes(body.len()),
            blake3: body_hash(&body),
        };
        header.check().map_err(|_| BodyFault::Manifest)?;
        check_body(&header, &body)?;
        Ok(Self { header, body })
    }

    /// Tells that the model has no place in the world: its coordinates are in a frame of its own.
    pub fn without_place(mut self) -> Self {
        self.header.codec = BodyCodec::PackedUnplaced;
        self
    }

    /// Sets the world frame of the model.
    pub fn in_frame(mut self, frame: FrameId) -> Self {
        self.header.frame = frame;
        self
    }
}
