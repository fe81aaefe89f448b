//! Reads and writes sequences of little-endian numbers.

/// Writes numbers one after another to a byte slice. Panics if the slice is too short.
pub(super) struct Writer<'a>(pub(super) &'a mut [u8]);

impl Writer<'_> {
    pub(super) fn bytes<const N: usize>(&mut self, bytes: [u8; N]) {
        let (head, tail) = core::mem::take(&mut self.0).split_at_mut(N);
        head.copy_from_slice(&bytes);
        self.0 = tail;
    }

    pub(super) fn f32s(&mut self, values: &[f32]) {
        values.iter().for_each(|v| self.bytes(v.to_le_bytes()));
    }

    pub(super) fn f64s(&mut self, values: &[f64]) {
        values.iter().for_each(|v| self.bytes(v.to_le_bytes()));
    }
}

/// Reads numbers one after another from a byte slice. Panics if the slice is too short.
pub(super) struct Reader<'a>(pub(super) &'a [u8]);

impl Reader<'_> {
    pub(super) fn bytes<const N: usize>(&mut self) -> [u8; N] {
        let (head, tail) = self.0.split_at(N);
        self.0 = tail;
        core::array::from_fn(|i| head[i])
    }

    pub(super) fn f32s<const N: usize>(&mut self) -> [f32; N] {
        core::array::from_fn(|_| f32::from_le_bytes(self.bytes()))
    }

    pub(super) fn f64s<const N: usize>(&mut self) -> [f64; N] {
        core::array::from_fn(|_| f64::from_le_bytes(self.bytes()))
    }
}

/// Zigzag encoding: moves the sign into the lowest bit, so that small numbers of either sign have few bits.
pub(super) fn zigzag(value: i16) -> u16 {
    ((value << 1) ^ (value >> 15)) as u16
}

/// Inverse of [`zigzag`].
pub(super) fn unzigzag(value: u16) -> i16 {
    (value >> 1) as i16 ^ -((value & 1) as i16)
}
