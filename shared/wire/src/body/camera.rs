//! Cameras, encoded without loss.

use super::bytes::{Reader, Writer};

/// Encoded size of a camera in bytes: quaternion wxyz, translation xyz, focal xy and centre xy as `f64`,
/// width and height as `u32`.
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
    /// Encodes the camera.
    pub fn encode(&self, out: &mut [u8; CAMERA_BYTES]) {
        let mut writer = Writer(out);
        writer.f64s(&self.quat);
        writer.f64s(&self.translation);
        writer.f64s(&self.focal_px);
        writer.f64s(&self.center_px);
        self.size_px.iter().for_each(|size| writer.bytes(size.to_le_bytes()));
    }

    /// Decodes a camera. Never fails: check the result with [`Self::is_sane`].
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

    /// Whether a renderer can use the camera: all values finite, a unit quaternion, positive focal lengths,
    /// and a picture of at least one pixel.
    pub fn is_sane(&self) -> bool {
        let norm2: f64 = self.quat.iter().map(|v| v * v).sum();
        (norm2 - 1.0).abs() < 1e-6
            && self.translation.iter().all(|v| v.is_finite())
            && self.focal_px.iter().all(|v| v.is_finite() && *v > 0.0)
            && self.center_px.iter().all(|v| v.is_finite())
            && self.size_px.iter().all(|v| *v > 0)
    }
}
