//! The shape of a splat, quantised to integers: position, rotation, scale, opacity and base colour.

use core::array;

use super::bytes::{Reader, Writer, unzigzag, zigzag};
use super::error::BodyError;

/// Size of a [`ShapeFrame`], which precedes the planes of a shapes pack, in bytes.
pub const SHAPE_FRAME_BYTES: usize = 20;
/// Number of planes: bytes per splat.
pub const SHAPE_BYTES: usize = 20;
/// A quaternion component is `(value / QUAT_ZERO - 1) √½`, in 10 bits: a normal is accurate to 0.07°.
pub const QUAT_ZERO: u16 = 511;
/// Mask of a quaternion component's 10 bits.
const QUAT_MASK: u16 = 1023;
/// Step of a log scale: 6 % of a length.
pub const LOG_SCALE_STEP: f32 = 1.0 / 16.0;
/// Step of a thickness: the shortest axis divided by the middle one. Linear, not logarithmic: most splats
/// are flat, so a relative error of their thickness is invisible.
pub const THICKNESS_STEP: f32 = 1.0 / 32.0;
/// Step of an opacity logit.
pub const OPACITY_STEP: f32 = 1.0 / 8.0;
/// Step of a degree-0 coefficient of the spherical harmonics: 1/128 of the colour range.
pub const COLOR_STEP: f32 = 1.0 / 128.0 / 0.282_094_8;

/// Largest magnitude of a log scale. e^±39 m exceeds any scene, and its square is still a finite `f32`.
pub const LOG_SCALE_MAX: f32 = 39.0;
/// Largest magnitude of a mean's coordinate. The largest position step still covers it.
pub const POSITION_MAX: f32 = 1e22;
/// Allowed exponents of the position step.
pub const STEP_EXPONENTS: core::ops::RangeInclusive<i8> = -60..=60;

/// The reference values of a shapes pack, from which its integers are measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShapeFrame {
    /// Origin of the positions, world units.
    pub origin: [f32; 3],
    /// Log scale that 0 steps stand for.
    pub log_scale: f32,
    /// The position step is 2 to this power, world units.
    pub step_exponent: i8,
}

impl ShapeFrame {
    /// Encodes the frame.
    pub fn encode(&self, out: &mut [u8; SHAPE_FRAME_BYTES]) {
        let mut writer = Writer(out);
        writer.f32s(&self.origin);
        writer.f32s(&[self.log_scale]);
        writer.bytes([self.step_exponent as u8, 0, 0, 0]);
    }

    /// Decodes and checks a frame. Every position measured from it is finite.
    pub fn decode(bytes: &[u8; SHAPE_FRAME_BYTES]) -> Result<Self, BodyError> {
        let mut reader = Reader(bytes);
        let origin = reader.f32s();
        let [log_scale] = reader.f32s();
        let [exponent, reserved @ ..] = reader.bytes::<4>();
        let frame = Self { origin, log_scale, step_exponent: exponent as i8 };
        // These comparisons are false for NaN.
        let is_sane = origin.iter().all(|v| v.abs() <= POSITION_MAX)
            && log_scale.abs() <= LOG_SCALE_MAX
            && STEP_EXPONENTS.contains(&frame.step_exponent)
            && reserved == [0; 3];
        is_sane.then_some(frame).ok_or(BodyError::BadPack)
    }
}

/// A quantised splat, without its view-dependent colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// Position in steps from the frame's origin.
    pub position: [u16; 3],
    /// Quaternion components x, y and z, each 0 to twice [`QUAT_ZERO`]. The component w is not stored: it is
    /// positive and the largest.
    pub quat: [u16; 3],
    /// The largest log scale in steps above the frame's, and the middle one in steps below the largest. Axes
    /// are in falling order, so the third is the normal.
    pub log_scale: [u8; 2],
    /// Shortest axis in steps of [`THICKNESS_STEP`], at most the length of the middle one.
    pub thickness: u8,
    /// Opacity logit in steps.
    pub opacity: i8,
    /// Red, green and blue in steps.
    pub color: [i16; 3],
}

impl Shape {
    /// The difference from this shape to `other`, field by field, each modulo its range.
    pub fn change_to(&self, other: &Shape) -> Shape {
        Shape {
            position: array::from_fn(|k| other.position[k].wrapping_sub(self.position[k])),
            quat: array::from_fn(|k| other.quat[k].wrapping_sub(self.quat[k]) & QUAT_MASK),
            log_scale: array::from_fn(|k| other.log_scale[k].wrapping_sub(self.log_scale[k])),
            thickness: other.thickness.wrapping_sub(self.thickness),
            opacity: other.opacity.wrapping_sub(self.opacity),
            color: array::from_fn(|k| other.color[k].wrapping_sub(self.color[k])),
        }
    }

    /// This shape with `change` applied: the inverse of [`Self::change_to`].
    pub fn changed(&self, change: &Shape) -> Shape {
        Shape {
            position: array::from_fn(|k| self.position[k].wrapping_add(change.position[k])),
            quat: array::from_fn(|k| self.quat[k].wrapping_add(change.quat[k]) & QUAT_MASK),
            log_scale: array::from_fn(|k| self.log_scale[k].wrapping_add(change.log_scale[k])),
            thickness: self.thickness.wrapping_add(change.thickness),
            opacity: self.opacity.wrapping_add(change.opacity),
            color: array::from_fn(|k| self.color[k].wrapping_add(change.color[k])),
        }
    }

    /// The shape's byte in every plane, with `offset` in place of the position.
    fn row(&self, offset: [u16; 3]) -> [u8; SHAPE_BYTES] {
        let [red, green, blue] = self.color;
        let offset = offset.map(|steps| zigzag(steps as i16));
        let colors = [green, red.wrapping_sub(green), blue.wrapping_sub(green)].map(zigzag);
        let low_bits = (0..3).fold(0, |bits, k| bits | (self.quat[k] & 3) << (2 * k)) as u8;
        array::from_fn(|plane| match plane {
            0..=5 => offset[plane / 2].to_le_bytes()[plane % 2],
            6..=8 => (self.quat[plane - 6] >> 2) as u8,
            9 => low_bits,
            10 | 11 => self.log_scale[plane - 10],
            12 => self.thickness,
            13 => self.opacity as u8,
            _ => colors[(plane - 14) / 2].to_le_bytes()[plane % 2],
        })
    }

    /// Inverse of [`Self::row`]: the position is the offset.
    fn from_row(byte: impl Fn(usize) -> u8) -> Self {
        let pair = |plane: usize| unzigzag(u16::from_le_bytes([byte(plane), byte(plane + 1)]));
        let green = pair(14);
        Self {
            position: array::from_fn(|k| pair(2 * k) as u16),
            quat: array::from_fn(|k| u16::from(byte(6 + k)) << 2 | u16::from(byte(9) >> (2 * k) & 3)),
            log_scale: array::from_fn(|k| byte(10 + k)),
            thickness: byte(12),
            opacity: byte(13) as i8,
            color: [pair(16).wrapping_add(green), green, pair(18).wrapping_add(green)],
        }
    }
}

/// Encodes `shapes` into [`SHAPE_BYTES`] planes of one byte per splat. Neighbouring bytes of a plane are
/// similar, which helps the compressor. Positions are stored as differences from the previous splat, red
/// and blue as differences from green.
///
/// # Panics
/// If the lengths do not match.
pub fn write_shapes(shapes: &[Shape], planes: &mut [u8]) {
    let mut before = [0u16; 3];
    write_rows(shapes, planes, |shape| {
        let offset = array::from_fn(|k| shape.position[k].wrapping_sub(before[k]));
        before = shape.position;
        offset
    });
}

/// Encodes changes ([`Shape::change_to`]) into the same planes, but with each position as it is.
///
/// # Panics
/// If the lengths do not match.
pub fn write_changes(changes: &[Shape], planes: &mut [u8]) {
    write_rows(changes, planes, |change| change.position);
}

fn write_rows(shapes: &[Shape], planes: &mut [u8], mut offset: impl FnMut(&Shape) -> [u16; 3]) {
    let n = shapes.len();
    assert_eq!(planes.len(), n * SHAPE_BYTES, "bytes of {n} shapes");
    for (i, shape) in shapes.iter().enumerate() {
        let row = shape.row(offset(shape));
        row.iter().enumerate().for_each(|(plane, byte)| planes[plane * n + i] = *byte);
    }
}

/// Decodes the output of [`write_shapes`]. Never fails: any bytes decode to shapes.
pub fn read_shapes(planes: &[u8]) -> impl ExactSizeIterator<Item = Shape> + '_ {
    let mut position = [0u16; 3];
    read_changes(planes).map(move |shape| {
        position = array::from_fn(|k| position[k].wrapping_add(shape.position[k]));
        Shape { position, ..shape }
    })
}

/// Decodes the output of [`write_changes`]. Never fails: any bytes decode to changes.
pub fn read_changes(planes: &[u8]) -> impl ExactSizeIterator<Item = Shape> + '_ {
    let n = planes.len() / SHAPE_BYTES;
    (0..n).map(move |i| Shape::from_row(|plane| planes[plane * n + i]))
}
