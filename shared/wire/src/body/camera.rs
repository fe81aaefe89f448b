//! Cameras, exactly.

use super::bytes::{Reader, Writer};

/// Bytes of one camera: quaternion wxyz, translation xyz, focal xy, centre xy as `f64`, width and height as
/// `u32`.
pub const CAMERA_BYTES: usize = 96;

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
