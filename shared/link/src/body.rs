//! Models to bodies and back, through the lossless layout of [`cosurf_wire::body`].
//!
//! A body from outside is checked wholly by [`check_body`] before anything is allocated for it.

use cosurf_scene::{Camera, Pose, Splats};
use cosurf_wire::body::{
    BODY_HEADER_BYTES, BodyError, BodyHeader, BodyReader, Bounds, CAMERA_BYTES, CameraRecord, MAX_SH_FLOATS,
    SplatRecord, sh_floats, splat_bytes,
};
use cosurf_wire::{BodyCodec, BodyHash, DeviceId, MAX_CHUNK_BYTES, ModelHeader, ModelId, ModelKind};
use glam::{DQuat, DVec2, DVec3};

/// What travels of a model: splats and the cameras that saw them; pictures stay home.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// The splats.
    pub splats: Splats,
    /// The cameras of the training views.
    pub cameras: Vec<Camera>,
}

/// What is wrong with a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BodyFault {
    /// Its layout.
    #[error(transparent)]
    Layout(#[from] BodyError),
    /// Its counts, degree or bounds differ from those announced.
    #[error("body and header disagree")]
    NotAsAnnounced,
    /// A camera that no renderer could use.
    #[error("camera {index} is not finite, has no rotation, or an empty picture")]
    Camera {
        /// Which.
        index: usize,
    },
    /// A value that no renderer could use.
    #[error("{field} of splat {index} is not finite or out of range")]
    Splat {
        /// Which.
        index: usize,
        /// Its field, as in [`Splats`].
        field: &'static str,
    },
    /// A mean outside the announced bounds.
    #[error("splat {index} lies outside the announced bounds")]
    OutOfBounds {
        /// Which.
        index: usize,
    },
    /// More splats or cameras than a `u32` counts.
    #[error("more splats or cameras than a body can count")]
    TooMany,
}

/// A model ready to be sent.
#[derive(Clone, Debug)]
pub struct Offer {
    /// What is announced.
    pub header: ModelHeader,
    /// What is sent in chunks; its size and hash are those of the header.
    pub body: Vec<u8>,
}

impl Offer {
    /// Packs a model; `views` counts the pictures that taught it. Refuses what a receiver would refuse.
    pub fn new(
        device: DeviceId,
        model: ModelId,
        kind: ModelKind,
        views: u32,
        splats: &Splats,
        cameras: &[Camera],
    ) -> Result<Self, BodyFault> {
        Self::from_body(device, model, kind, views, model_to_body(splats, cameras)?)
    }

    /// The same from a body that is already packed.
    pub fn from_body(
        device: DeviceId,
        model: ModelId,
        kind: ModelKind,
        views: u32,
        body: Vec<u8>,
    ) -> Result<Self, BodyFault> {
        let BodyHeader { splats, cameras, sh_degree, bounds } = *BodyReader::new(&body)?.header();
        let header = ModelHeader {
            device,
            model,
            kind,
            codec: BodyCodec::Lossless,
            sh_degree,
            splats,
            cameras,
            views,
            bounds,
            body_bytes: body.len() as u64,
            chunk_bytes: MAX_CHUNK_BYTES as u32,
            blake3: body_hash(&body),
        };
        check_body(&header, &body)?;
        Ok(Self { header, body })
    }
}

/// BLAKE3 of a body.
pub fn body_hash(body: &[u8]) -> BodyHash {
    BodyHash(*blake3::hash(body).as_bytes())
}

/// Packs splats and cameras into a body whose bounds are the box around the means.
pub fn model_to_body(splats: &Splats, cameras: &[Camera]) -> Result<Vec<u8>, BodyFault> {
    let header = BodyHeader {
        splats: u32::try_from(splats.len()).map_err(|_| BodyFault::TooMany)?,
        cameras: u32::try_from(cameras.len()).map_err(|_| BodyFault::TooMany)?,
        sh_degree: splats.sh_degree as u8,
        bounds: bounds_of(&splats.means),
    };
    let mut body = vec![0; header.body_bytes() as usize];
    let (head, rest) = body.split_first_chunk_mut::<BODY_HEADER_BYTES>().ok_or(BodyError::Truncated)?;
    header.encode(head);
    let (camera_bytes, splat_area) = rest.split_at_mut(cameras.len() * CAMERA_BYTES);
    for (camera, out) in cameras.iter().zip(camera_bytes.as_chunks_mut().0) {
        camera_record(camera).encode(out);
    }
    for (i, out) in splat_area.chunks_exact_mut(splat_bytes(header.sh_degree)).enumerate() {
        splat_record(splats, i).encode(splats.sh_of(i), out);
    }
    Ok(body)
}

/// Checks all of a body against its announcement: sizes, every value, every mean inside the bounds.
/// Allocates nothing.
pub fn check_body(header: &ModelHeader, body: &[u8]) -> Result<(), BodyFault> {
    let reader = BodyReader::new(body)?;
    let own = reader.header();
    let announced = (header.splats, header.cameras, header.sh_degree, header.bounds);
    if (own.splats, own.cameras, own.sh_degree, own.bounds) != announced {
        return Err(BodyFault::NotAsAnnounced);
    }
    check_values(&reader)
}

/// Unpacks a body after checking all of it, but for the agreement with an announcement.
pub fn body_to_model(body: &[u8]) -> Result<Model, BodyFault> {
    let reader = BodyReader::new(body)?;
    check_values(&reader)?;
    let header = reader.header();
    let mut splats = Splats::with_capacity(header.splats as usize, u32::from(header.sh_degree));
    let mut sh = [0.0; MAX_SH_FLOATS];
    let sh = &mut sh[..sh_floats(header.sh_degree)];
    for bytes in reader.splats() {
        let splat = SplatRecord::decode(bytes, sh);
        splats.push(splat.mean, splat.quat, splat.log_scale, splat.opacity_logit, sh);
    }
    Ok(Model { splats, cameras: reader.cameras().map(|record| camera(&record)).collect() })
}

fn check_values(reader: &BodyReader<'_>) -> Result<(), BodyFault> {
    if let Some(index) = reader.cameras().position(|camera| !camera.is_sane()) {
        return Err(BodyFault::Camera { index });
    }
    let mut sh = [0.0; MAX_SH_FLOATS];
    let sh = &mut sh[..sh_floats(reader.header().sh_degree)];
    for (index, bytes) in reader.splats().enumerate() {
        let splat = SplatRecord::decode(bytes, sh);
        if let Some(field) = splat.find_bad_field(sh) {
            return Err(BodyFault::Splat { index, field });
        }
        if !reader.header().bounds.contains(splat.mean) {
            return Err(BodyFault::OutOfBounds { index });
        }
    }
    Ok(())
}

/// The box around `means`; the origin where there are none.
fn bounds_of(means: &[[f32; 3]]) -> Bounds {
    let Some(&first) = means.first() else {
        return Bounds { min: [0.0; 3], max: [0.0; 3] };
    };
    let fold = |pick: fn(f32, f32) -> f32| {
        means.iter().fold(first, |corner, mean| std::array::from_fn(|k| pick(corner[k], mean[k])))
    };
    Bounds { min: fold(f32::min), max: fold(f32::max) }
}

fn splat_record(splats: &Splats, i: usize) -> SplatRecord {
    SplatRecord {
        mean: splats.means[i],
        quat: splats.quats[i],
        log_scale: splats.log_scales[i],
        opacity_logit: splats.opacity_logits[i],
    }
}

fn camera_record(camera: &Camera) -> CameraRecord {
    let Pose { rotation: q, translation } = camera.cam_from_world;
    CameraRecord {
        quat: [q.w, q.x, q.y, q.z],
        translation: translation.to_array(),
        focal_px: camera.focal_px.to_array(),
        center_px: camera.center_px.to_array(),
        size_px: camera.size_px,
    }
}

fn camera(record: &CameraRecord) -> Camera {
    let [w, x, y, z] = record.quat;
    Camera {
        cam_from_world: Pose {
            rotation: DQuat::from_xyzw(x, y, z, w),
            translation: DVec3::from_array(record.translation),
        },
        focal_px: DVec2::from_array(record.focal_px),
        center_px: DVec2::from_array(record.center_px),
        size_px: record.size_px,
    }
}
