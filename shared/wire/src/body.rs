//! How a model (splats and the cameras that saw them, never pictures) is laid out in bytes, losslessly.
//!
//! Little-endian throughout, no padding, every size exact:
//!
//! | Part | Bytes | Content |
//! |---|---|---|
//! | header | 40 | `b"CSGB"`, layout version 1, `sh_degree`, two zero bytes, `splats: u32`, `cameras: u32`, bounds min xyz and max xyz `f32` |
//! | cameras | 96 each | quaternion wxyz `f64`, translation xyz `f64`, focal xy `f64`, centre xy `f64`, width and height `u32` |
//! | splats | 44 + 12 (sh_degree + 1)² each | mean xyz, quaternion wxyz, log scale xyz, opacity logit, SH `[(sh_degree + 1)², rgb]`, all `f32` |
//!
//! These are leaf functions: they convert and check sizes. Whether the values make sense is asked by
//! [`SplatRecord::find_bad_field`] and [`CameraRecord::is_sane`].

use core::fmt;

use serde::{Deserialize, Serialize};

/// Bytes of the body's own header.
pub const BODY_HEADER_BYTES: usize = 40;
/// Bytes of one camera.
pub const CAMERA_BYTES: usize = 96;
/// Highest degree of spherical harmonics.
pub const MAX_SH_DEGREE: u8 = 3;
/// Most floats of spherical harmonics per splat.
pub const MAX_SH_FLOATS: usize = sh_floats(MAX_SH_DEGREE);
/// Largest magnitude of a log scale that is let in: e^±40 m is beyond any scene, and its square is
/// still a finite `f32`.
pub const MAX_ABS_LOG_SCALE: f32 = 40.0;

const MAGIC: [u8; 4] = *b"CSGB";
const LAYOUT: u8 = 1;

/// Floats of spherical harmonics per splat: `3 (sh_degree + 1)²`.
pub const fn sh_floats(sh_degree: u8) -> usize {
    let n = sh_degree as usize + 1;
    3 * n * n
}

/// Bytes of one splat.
pub const fn splat_bytes(sh_degree: u8) -> usize {
    44 + 4 * sh_floats(sh_degree)
}

/// Bytes of a whole body; no `u32` counts can overflow it.
pub const fn body_bytes(splats: u32, cameras: u32, sh_degree: u8) -> u64 {
    BODY_HEADER_BYTES as u64
        + cameras as u64 * CAMERA_BYTES as u64
        + splats as u64 * splat_bytes(sh_degree) as u64
}

/// An axis-aligned box in the world frame, both corners belonging to it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Least x, y and z, world units.
    pub min: [f32; 3],
    /// Greatest x, y and z, world units.
    pub max: [f32; 3],
}

impl Bounds {
    /// Whether both corners are finite and in order.
    pub fn is_sane(&self) -> bool {
        (0..3).all(|k| self.min[k].is_finite() && self.max[k].is_finite() && self.min[k] <= self.max[k])
    }

    /// Whether a point is inside; NaN never is.
    pub fn contains(&self, point: [f32; 3]) -> bool {
        (0..3).all(|k| point[k] >= self.min[k] && point[k] <= self.max[k])
    }
}

/// Why bytes are no body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BodyError {
    /// Too short for a header.
    Truncated,
    /// It does not begin with `CSGB`.
    BadMagic,
    /// A layout this build does not know.
    UnknownLayout(u8),
    /// The degree is above [`MAX_SH_DEGREE`], or reserved bytes are not zero, or the bounds are no box.
    BadHeader,
    /// The bytes are not as many as the counts ask for.
    WrongSize {
        /// What the header's counts ask for.
        expected: u64,
        /// What is there.
        found: u64,
    },
}

impl fmt::Display for BodyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated => write!(f, "body shorter than its {BODY_HEADER_BYTES}-byte header"),
            Self::BadMagic => write!(f, "body does not begin with CSGB"),
            Self::UnknownLayout(found) => {
                write!(f, "body layout {found} is not {LAYOUT}: update this program")
            }
            Self::BadHeader => write!(f, "body header with impossible values"),
            Self::WrongSize { expected, found } => {
                write!(f, "body of {found} bytes, its header asks for {expected}")
            }
        }
    }
}

impl core::error::Error for BodyError {}

/// The first bytes of a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyHeader {
    /// How many splats.
    pub splats: u32,
    /// How many cameras.
    pub cameras: u32,
    /// 0 to [`MAX_SH_DEGREE`].
    pub sh_degree: u8,
    /// Holds every mean.
    pub bounds: Bounds,
}

impl BodyHeader {
    /// Bytes of the whole body.
    pub fn body_bytes(&self) -> u64 {
        body_bytes(self.splats, self.cameras, self.sh_degree)
    }

    /// Writes the header.
    pub fn encode(&self, out: &mut [u8; BODY_HEADER_BYTES]) {
        let mut writer = Writer(out);
        writer.bytes(MAGIC);
        writer.bytes([LAYOUT, self.sh_degree, 0, 0]);
        writer.bytes(self.splats.to_le_bytes());
        writer.bytes(self.cameras.to_le_bytes());
        writer.f32s(&self.bounds.min);
        writer.f32s(&self.bounds.max);
    }

    /// Reads and checks the header at the start of a body.
    pub fn decode(body: &[u8]) -> Result<Self, BodyError> {
        let bytes: &[u8; BODY_HEADER_BYTES] = body.first_chunk().ok_or(BodyError::Truncated)?;
        let mut reader = Reader(bytes);
        if reader.bytes() != MAGIC {
            return Err(BodyError::BadMagic);
        }
        let [layout, sh_degree, reserved @ ..] = reader.bytes::<4>();
        if layout != LAYOUT {
            return Err(BodyError::UnknownLayout(layout));
        }
        let splats = u32::from_le_bytes(reader.bytes());
        let cameras = u32::from_le_bytes(reader.bytes());
        let bounds = Bounds { min: reader.f32s(), max: reader.f32s() };
        if reserved != [0, 0] || sh_degree > MAX_SH_DEGREE || !bounds.is_sane() {
            return Err(BodyError::BadHeader);
        }
        Ok(Self { splats, cameras, sh_degree, bounds })
    }
}

/// A pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraRecord {
    /// Rotation `cam_from_world` as a unit quaternion wxyz.
    pub quat: [f64; 4],
    /// Translation `cam_from_world`, world units.
    pub translation: [f64; 3],
    /// Focal lengths, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub center_px: [f64; 2],
    /// Width and height, pixels.
    pub size_px: [u32; 2],
}

impl CameraRecord {
    /// Writes the camera.
    pub fn encode(&self, out: &mut [u8; CAMERA_BYTES]) {
        let mut writer = Writer(out);
        writer.f64s(&self.quat);
        writer.f64s(&self.translation);
        writer.f64s(&self.focal_px);
        writer.f64s(&self.center_px);
        self.size_px.iter().for_each(|size| writer.bytes(size.to_le_bytes()));
    }

    /// Reads a camera; any bytes are some camera.
    pub fn decode(bytes: &[u8; CAMERA_BYTES]) -> Self {
        let mut reader = Reader(bytes);
        Self {
            quat: reader.f64s(),
            translation: reader.f64s(),
            focal_px: reader.f64s(),
            center_px: reader.f64s(),
            size_px: [u32::from_le_bytes(reader.bytes()), u32::from_le_bytes(reader.bytes())],
        }
    }

    /// Whether a renderer could use it: all finite, a rotation of unit length, focal lengths positive,
    /// no empty picture.
    pub fn is_sane(&self) -> bool {
        let norm2: f64 = self.quat.iter().map(|v| v * v).sum();
        (norm2 - 1.0).abs() < 1e-6
            && self.translation.iter().all(|v| v.is_finite())
            && self.focal_px.iter().all(|v| v.is_finite() && *v > 0.0)
            && self.center_px.iter().all(|v| v.is_finite())
            && self.size_px.iter().all(|v| *v > 0)
    }
}

/// A splat but for its spherical harmonics, in the stored (pre-activation) form.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatRecord {
    /// Centre, world units.
    pub mean: [f32; 3],
    /// Rotation `world_from_splat` wxyz, any non-zero length.
    pub quat: [f32; 4],
    /// Natural logarithms of the standard deviations, world units.
    pub log_scale: [f32; 3],
    /// Opacity before the logistic function.
    pub opacity_logit: f32,
}

impl SplatRecord {
    /// Writes the splat into exactly [`splat_bytes`] bytes.
    ///
    /// # Panics
    /// Where the lengths of `sh` and `out` do not belong to one degree.
    pub fn encode(&self, sh: &[f32], out: &mut [u8]) {
        assert_eq!(out.len(), 44 + 4 * sh.len(), "bytes of a splat with {} SH floats", sh.len());
        let mut writer = Writer(out);
        writer.f32s(&self.mean);
        writer.f32s(&self.quat);
        writer.f32s(&self.log_scale);
        writer.f32s(&[self.opacity_logit]);
        writer.f32s(sh);
    }

    /// Reads a splat from exactly [`splat_bytes`] bytes, its spherical harmonics into `sh`; any bytes
    /// are some splat.
    ///
    /// # Panics
    /// Where the lengths of `sh` and `bytes` do not belong to one degree.
    pub fn decode(bytes: &[u8], sh: &mut [f32]) -> Self {
        assert_eq!(bytes.len(), 44 + 4 * sh.len(), "bytes of a splat with {} SH floats", sh.len());
        let mut reader = Reader(bytes);
        let splat = Self {
            mean: reader.f32s(),
            quat: reader.f32s(),
            log_scale: reader.f32s(),
            opacity_logit: f32::from_le_bytes(reader.bytes()),
        };
        sh.iter_mut().for_each(|v| *v = f32::from_le_bytes(reader.bytes()));
        splat
    }

    /// The first field that no renderer could use, or `None` where all is well: every value finite,
    /// the quaternion not of zero length, log scales within [`MAX_ABS_LOG_SCALE`].
    pub fn find_bad_field(&self, sh: &[f32]) -> Option<&'static str> {
        let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
        let norm2: f32 = self.quat.iter().map(|v| v * v).sum();
        // Phrased so that NaN fails each.
        let scale_fits = self.log_scale.iter().all(|v| v.abs() < MAX_ABS_LOG_SCALE);
        match () {
            () if !finite(&self.mean) => Some("mean"),
            () if !(norm2.is_finite() && norm2 >= 1e-12) => Some("quat"),
            () if !scale_fits => Some("log_scale"),
            () if !self.opacity_logit.is_finite() => Some("opacity_logit"),
            () if !finite(sh) => Some("sh"),
            () => None,
        }
    }
}

/// A body of the right size, read in place.
#[derive(Clone, Copy, Debug)]
pub struct BodyReader<'a> {
    header: BodyHeader,
    cameras: &'a [u8],
    splats: &'a [u8],
}

impl<'a> BodyReader<'a> {
    /// Checks the header and that the size is exactly what it asks for.
    pub fn new(body: &'a [u8]) -> Result<Self, BodyError> {
        let header = BodyHeader::decode(body)?;
        if header.body_bytes() != body.len() as u64 {
            return Err(BodyError::WrongSize { expected: header.body_bytes(), found: body.len() as u64 });
        }
        let (cameras, splats) = body[BODY_HEADER_BYTES..].split_at(header.cameras as usize * CAMERA_BYTES);
        Ok(Self { header, cameras, splats })
    }

    /// The body's own header.
    pub fn header(&self) -> &BodyHeader {
        &self.header
    }

    /// The cameras in order.
    pub fn cameras(&self) -> impl ExactSizeIterator<Item = CameraRecord> + 'a {
        self.cameras.as_chunks().0.iter().map(CameraRecord::decode)
    }

    /// The bytes of each splat in order, for [`SplatRecord::decode`].
    pub fn splats(&self) -> impl ExactSizeIterator<Item = &'a [u8]> + 'a {
        self.splats.chunks_exact(splat_bytes(self.header.sh_degree))
    }
}

struct Writer<'a>(&'a mut [u8]);

impl Writer<'_> {
    fn bytes<const N: usize>(&mut self, bytes: [u8; N]) {
        let (head, tail) = core::mem::take(&mut self.0).split_at_mut(N);
        head.copy_from_slice(&bytes);
        self.0 = tail;
    }

    fn f32s(&mut self, values: &[f32]) {
        values.iter().for_each(|v| self.bytes(v.to_le_bytes()));
    }

    fn f64s(&mut self, values: &[f64]) {
        values.iter().for_each(|v| self.bytes(v.to_le_bytes()));
    }
}

struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        let (head, tail) = self.0.split_at(N);
        self.0 = tail;
        core::array::from_fn(|i| head[i])
    }

    fn f32s<const N: usize>(&mut self) -> [f32; N] {
        core::array::from_fn(|_| f32::from_le_bytes(self.bytes()))
    }

    fn f64s<const N: usize>(&mut self) -> [f64; N] {
        core::array::from_fn(|_| f64::from_le_bytes(self.bytes()))
    }
}
