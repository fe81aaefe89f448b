//! Cameras, encoded without loss.

use super::bytes::{Reader, Writer};

/// Encoded size of a camera in bytes: quaternion wxyz, translation xyz, focal xy and centre xy as `f64`,
/// width and height as `u32`.
pub const CAMERA_BYTES: usize = 96;

/// Limit on the number of pixels of a picture: more than any drone's camera has.
const PICTURE_PX_MAX: u64 = 1 << 28;
/// Limit on the absolute value of each coordinate of a translation, world units: more than the size of the earth.
const TRANSLATION_MAX: f64 = 1e8;
/// Smallest and largest focal length, as shares of the long side of the picture: fields of view of 168° and 0.06°.
const FOCAL_SHARES: core::ops::RangeInclusive<f64> = 0.05..=1000.0;

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

    /// Whether the camera may be a real one: a unit quaternion, a translation within [`TRANSLATION_MAX`], a picture of
    /// at least one pixel and at most [`PICTURE_PX_MAX`], focal lengths within [`FOCAL_SHARES`], and a principal point at
    /// most ten long sides from the corner. No value is infinite or NaN.
    pub fn is_sane(&self) -> bool {
        let norm2: f64 = self.quat.iter().map(|v| v * v).sum();
        let [width, height] = self.size_px;
        let pixels = u64::from(width) * u64::from(height);
        let long_side_px = f64::from(width.max(height));
        let is_within = |v: &f64, most: f64| (-most..=most).contains(v);
        (norm2 - 1.0).abs() < 1e-6
            && (1..=PICTURE_PX_MAX).contains(&pixels)
            && self.translation.iter().all(|v| is_within(v, TRANSLATION_MAX))
            && self.focal_px.iter().all(|v| FOCAL_SHARES.contains(&(v / long_side_px)))
            && self.center_px.iter().all(|v| is_within(v, 10.0 * long_side_px))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: CameraRecord = CameraRecord {
        quat: [1.0, 0.0, 0.0, 0.0],
        translation: [500_000.0, -5_800_000.0, 120.0],
        focal_px: [3600.0, 3610.0],
        center_px: [2000.0, 1500.0],
        size_px: [4000, 3000],
    };

    #[test]
    fn real_cameras_are_sane_and_absurd_ones_are_not() {
        let phone = CameraRecord { focal_px: [20.0; 2], center_px: [12.0, 8.0], size_px: [24, 16], ..CAMERA };
        let largest = CameraRecord { size_px: [16_384, 16_384], ..CAMERA };
        assert!([CAMERA, phone, largest].iter().all(CameraRecord::is_sane));
        let absurd = [
            CameraRecord { quat: [1.0, 1.0, 0.0, 0.0], ..CAMERA },
            CameraRecord { quat: [f64::NAN; 4], ..CAMERA },
            CameraRecord { translation: [1.7e308, 0.0, 0.0], ..CAMERA },
            CameraRecord { translation: [0.0, f64::NEG_INFINITY, 0.0], ..CAMERA },
            CameraRecord { focal_px: [1e200, 3600.0], ..CAMERA },
            CameraRecord { focal_px: [3600.0, 1e-6], ..CAMERA },
            CameraRecord { focal_px: [-3600.0, 3600.0], ..CAMERA },
            CameraRecord { center_px: [1e9, 0.0], ..CAMERA },
            CameraRecord { center_px: [f64::NAN, 0.0], ..CAMERA },
            CameraRecord { size_px: [0, 3000], ..CAMERA },
            CameraRecord { size_px: [200_000, 200_000], ..CAMERA },
            CameraRecord { size_px: [u32::MAX, u32::MAX], ..CAMERA },
        ];
        for camera in absurd {
            assert!(!camera.is_sane(), "{camera:?}");
        }
    }
}
