//! The shape of a splat in whole numbers: where, how it is turned, how large, how opaque, which colour.

use core::array;

use super::BodyError;
use super::bytes::{Reader, Writer, unzigzag, zigzag};

/// Bytes of a pack of shapes before its planes.
pub const SHAPE_FRAME_BYTES: usize = 20;
/// Bytes of a splat in the planes.
pub const SHAPE_BYTES: usize = 20;
/// A component of the quaternion is `(value / QUAT_ZERO - 1) √½`: 10 bits, 0.07° for a normal.
pub const QUAT_ZERO: u16 = 511;
/// Bits of a component of the quaternion.
const QUAT_MASK: u16 = 1023;
/// One step of a log scale: 6 % of a length.
pub const LOG_SCALE_STEP: f32 = 1.0 / 16.0;
/// One step of a thickness: the least axis in parts of the middle one. What matters is the absolute length: most
/// splats are flat.
pub const THICKNESS_STEP: f32 = 1.0 / 32.0;
/// One step of an opacity logit.
pub const OPACITY_STEP: f32 = 1.0 / 8.0;
/// One step of a coefficient of the zeroth spherical harmonic: 1/128 of the range of colour.
pub const COLOR_STEP: f32 = 1.0 / 128.0 / 0.282_094_8;

/// Largest magnitude of a log scale: e^±39 m is beyond any scene, and its square is still a finite `f32`.
pub const LOG_SCALE_MAX: f32 = 39.0;
/// Largest magnitude of a mean's coordinates, which the greatest step still reaches.
pub const POSITION_MAX: f32 = 1e22;
/// Exponents of the step of positions.
pub const STEP_EXPONENTS: core::ops::RangeInclusive<i8> = -60..=60;

/// What the numbers of a pack of shapes are measured from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShapeFrame {
    /// Where positions are counted from, world units.
    pub origin: [f32; 3],
    /// Where log scales are counted from.
    pub log_scale: f32,
    /// A position's step is 2 to this power, world units.
    pub step_exponent: i8,
}

impl ShapeFrame {
    /// Writes it.
    pub fn encode(&self, out: &mut [u8; SHAPE_FRAME_BYTES]) {
        let mut writer = Writer(out);
        writer.f32s(&self.origin);
        writer.f32s(&[self.log_scale]);
        writer.bytes([self.step_exponent as u8, 0, 0, 0]);
    }

    /// Reads it; every position counted from it is finite.
    pub fn decode(bytes: &[u8; SHAPE_FRAME_BYTES]) -> Result<Self, BodyError> {
        let mut reader = Reader(bytes);
        let origin = reader.f32s();
        let [log_scale] = reader.f32s();
        let [exponent, reserved @ ..] = reader.bytes::<4>();
        let frame = Self { origin, log_scale, step_exponent: exponent as i8 };
        // Phrased so that NaN fails.
        let is_sane = origin.iter().all(|v| v.abs() <= POSITION_MAX)
            && log_scale.abs() <= LOG_SCALE_MAX
            && STEP_EXPONENTS.contains(&frame.step_exponent)
            && reserved == [0; 3];
        is_sane.then_some(frame).ok_or(BodyError::BadPack)
    }
}

/// A splat but for what its colour does with the direction, in whole numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// Steps from the frame's origin.
    pub position: [u16; 3],
    /// The quaternion's x, y and z, twice [`QUAT_ZERO`] at most; its w is the largest and positive.
    pub quat: [u16; 3],
    /// Steps of the largest log scale above the frame's, and of the middle one below that. Axes are in
    /// falling order, so the third is the normal.
    pub log_scale: [u8; 2],
    /// Steps of the least axis; as many as make the middle one at most.
    pub thickness: u8,
    /// Steps of the opacity logit.
    pub opacity: i8,
    /// Steps of red, green and blue.
    pub color: [i16; 3],
}

impl Shape {
    /// What makes `other` of this, field by field, each modulo its range.
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

    /// What `change` makes of this; the inverse of [`Self::change_to`].
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

    /// Its byte in every plane, with `way` in the place of the position.
    fn row(&self, way: [u16; 3]) -> [u8; SHAPE_BYTES] {
        let [red, green, blue] = self.color;
        let way = way.map(|steps| zigzag(steps as i16));
        let colors = [green, red.wrapping_sub(green), blue.wrapping_sub(green)].map(zigzag);
        let low_bits = (0..3).fold(0, |bits, k| bits | (self.quat[k] & 3) << (2 * k)) as u8;
        array::from_fn(|plane| match plane {
            0..=5 => way[plane / 2].to_le_bytes()[plane % 2],
            6..=8 => (self.quat[plane - 6] >> 2) as u8,
            9 => low_bits,
            10 | 11 => self.log_scale[plane - 10],
            12 => self.thickness,
            13 => self.opacity as u8,
            _ => colors[(plane - 14) / 2].to_le_bytes()[plane % 2],
        })
    }

    /// The splat with these bytes; its position is the way.
    fn of_row(byte: impl Fn(usize) -> u8) -> Self {
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

/// Writes `shapes` into exactly [`SHAPE_BYTES`] planes of one byte each: neighbours in a plane are alike,
/// which a compressor likes. Positions go as differences from the splat before; red and blue from green.
///
/// # Panics
/// Where the lengths do not belong together.
pub fn write_shapes(shapes: &[Shape], planes: &mut [u8]) {
    let mut before = [0u16; 3];
    write_rows(shapes, planes, |shape| {
        let way = array::from_fn(|k| shape.position[k].wrapping_sub(before[k]));
        before = shape.position;
        way
    });
}

/// Writes what becomes of shapes ([`Shape::change_to`]) into planes of the same kind, positions as they are.
///
/// # Panics
/// Where the lengths do not belong together.
pub fn write_changes(changes: &[Shape], planes: &mut [u8]) {
    write_rows(changes, planes, |change| change.position);
}

fn write_rows(shapes: &[Shape], planes: &mut [u8], mut way: impl FnMut(&Shape) -> [u16; 3]) {
    let n = shapes.len();
    assert_eq!(planes.len(), n * SHAPE_BYTES, "bytes of {n} shapes");
    for (i, shape) in shapes.iter().enumerate() {
        let row = shape.row(way(shape));
        row.iter().enumerate().for_each(|(plane, byte)| planes[plane * n + i] = *byte);
    }
}

/// Reads what [`write_shapes`] wrote; any bytes are some shapes.
pub fn read_shapes(planes: &[u8]) -> impl ExactSizeIterator<Item = Shape> + '_ {
    let mut position = [0u16; 3];
    read_changes(planes).map(move |shape| {
        position = array::from_fn(|k| position[k].wrapping_add(shape.position[k]));
        Shape { position, ..shape }
    })
}

/// Reads what [`write_changes`] wrote; any bytes are some changes.
pub fn read_changes(planes: &[u8]) -> impl ExactSizeIterator<Item = Shape> + '_ {
    let n = planes.len() / SHAPE_BYTES;
    (0..n).map(move |i| Shape::of_row(|plane| planes[plane * n + i]))
}
