//! The shape of a splat, quantised to integers: position, rotation, scale, opacity and base colour.

use core::array;

use super::bytes::{Reader, Writer, unzigzag, zigzag};
use super::error::BodyError;

/// Size in bytes of a [`ShapeFrame`], which comes before the planes of a shapes pack.
pub const SHAPE_FRAME_BYTES: usize = 20;
/// Number of byte planes. Each plane has one byte of every splat, so this is also the number of bytes per
/// splat.
pub const SHAPE_BYTES: usize = 20;
/// The integer that stands for a quaternion component of 0. A component is `(value / QUAT_ZERO - 1) √½`,
/// where `value` has 10 bits. The median error of a normal is below 0.07°.
pub const QUAT_ZERO: u16 = 511;
/// Mask of a quaternion component's 10 bits.
const QUAT_MASK: u16 = 1023;
/// Step of a log scale. One step changes the length of an axis by 6 %.
pub const LOG_SCALE_STEP: f32 = 1.0 / 16.0;
/// Step of a thickness, which is the length of the shortest axis divided by that of the middle axis.
/// Thickness is stored linearly, not as a logarithm: most splats are flat, so even a large relative error
/// of their thickness is invisible.
pub const THICKNESS_STEP: f32 = 1.0 / 32.0;
/// Step of an opacity logit.
pub const OPACITY_STEP: f32 = 1.0 / 8.0;
/// Step of a degree-0 coefficient of the spherical harmonics. One step changes the colour by 1/128 of its
/// range.
pub const COLOR_STEP: f32 = 1.0 / 128.0 / 0.282_094_8;

/// Largest magnitude of a log scale. e^39 is larger than any scene and e^-39 smaller than any detail. The
/// squares of both are still normal `f32` numbers.
pub const LOG_SCALE_MAX: f32 = 39.0;
/// Largest magnitude of a position's coordinate, world units. With the largest position step, 16 bits still
/// span the range from `-POSITION_MAX` to `POSITION_MAX`.
pub const POSITION_MAX: f32 = 1e22;
/// Allowed exponents of the position step ([`ShapeFrame::step_exponent`]).
pub const STEP_EXPONENTS: core::ops::RangeInclusive<i8> = -60..=60;

/// The reference values of a shapes pack. Its positions and its log scales are numbers of steps from these
/// values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShapeFrame {
    /// Origin of the positions, world units.
    pub origin: [f32; 3],
    /// Log scale that 0 steps stand for: the smallest that the pack can store for a longest axis.
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

    /// Decodes and checks a frame. With a valid frame, every position of the pack is finite.
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

/// A quantised splat without its view-dependent colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// Position, in steps from the origin of the pack's [`ShapeFrame`].
    pub position: [u16; 3],
    /// Quaternion components x, y and z, each 0 to twice [`QUAT_ZERO`]. The component w is not stored: it
    /// is positive and the largest, and follows from the unit length.
    pub quat: [u16; 3],
    /// Log scales of the longest and the middle axis, in steps of [`LOG_SCALE_STEP`]. The longest is
    /// counted up from [`ShapeFrame::log_scale`], the middle down from the longest. The axes are in order
    /// of falling length, so the third axis is the normal.
    pub log_scale: [u8; 2],
    /// Length of the shortest axis divided by that of the middle axis, in steps of [`THICKNESS_STEP`]. The
    /// quotient is at most 1; a decoder reads a larger stored value as about 1.
    pub thickness: u8,
    /// Opacity logit, in steps of [`OPACITY_STEP`].
    pub opacity: i8,
    /// Red, green and blue, in steps of [`COLOR_STEP`].
    pub color: [i16; 3],
}

impl Shape {
    /// The difference from this shape to `other`, field by field. Each difference is taken modulo the range
    /// of its field.
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

    /// The encoded bytes of this shape, one for each byte plane. `offset` is encoded instead of the
    /// position.
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

    /// Inverse of [`Self::row`]. `byte` gives the encoded byte of a plane. The position of the result is
    /// the encoded offset.
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
/// similar, so they compress well. Positions are stored as differences from the previous splat. Red and
/// blue are stored as differences from green.
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

/// Encodes changes ([`Shape::change_to`]) like [`write_shapes`], but stores the change of each position
/// itself, not its difference from the previous splat's.
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
