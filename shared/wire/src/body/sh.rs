//! Spherical harmonics in whole numbers along the directions of a basis.

use super::{BodyError, sh_rest};

/// How the spherical harmonics of a splat are laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ShLayout {
    /// Directions that are kept, the one of the greatest variance first.
    pub components: u8,
    /// How many of them, from the first, have a byte of their own (-128 to 127 steps); the others share one by
    /// two (-8 to 7 steps).
    pub wide: u8,
}

impl ShLayout {
    /// Of no spherical harmonics.
    pub const NONE: Self = Self { components: 0, wide: 0 };

    /// Checks it against a degree.
    pub fn check(self, sh_degree: u8) -> Result<Self, BodyError> {
        let is_sane = self.wide <= self.components && usize::from(self.components) <= sh_rest(sh_degree);
        is_sane.then_some(self).ok_or(BodyError::BadPack)
    }

    /// Bytes of one splat.
    pub fn splat_bytes(self) -> usize {
        usize::from(self.wide) + usize::from(self.components - self.wide).div_ceil(2)
    }

    /// The nearest number of steps along `component` that can be written.
    pub fn clamp(self, component: usize, steps: i32) -> i8 {
        let is_wide = component < usize::from(self.wide);
        (if is_wide { steps.clamp(-128, 127) } else { steps.clamp(-8, 7) }) as i8
    }

    /// Writes `steps`, `[n, components]`, into exactly [`Self::splat_bytes`] planes of `n` bytes.
    ///
    /// # Panics
    /// Where the lengths do not belong together.
    pub fn write(self, steps: &[i8], planes: &mut [u8]) {
        let (components, wide) = (usize::from(self.components), usize::from(self.wide));
        let n = steps.len().checked_div(components).unwrap_or(0);
        assert_eq!(planes.len(), n * self.splat_bytes(), "bytes of {n} splats' spherical harmonics");
        for (i, steps) in steps.chunks_exact(components.max(1)).enumerate() {
            for (plane, value) in steps[..wide].iter().enumerate() {
                planes[plane * n + i] = zigzag(*value);
            }
            for (pair, values) in steps[wide..].chunks(2).enumerate() {
                let high = values.get(1).map_or(0, |value| zigzag(*value));
                planes[(wide + pair) * n + i] = zigzag(values[0]) & 15 | high << 4;
            }
        }
    }

    /// The steps of splat `i` of `n` along `component`.
    pub fn read(self, planes: &[u8], n: usize, i: usize, component: usize) -> i8 {
        let wide = usize::from(self.wide);
        if component < wide {
            return unzigzag(planes[component * n + i]);
        }
        let byte = planes[(wide + (component - wide) / 2) * n + i];
        unzigzag(if (component - wide).is_multiple_of(2) { byte & 15 } else { byte >> 4 })
    }
}

fn zigzag(value: i8) -> u8 {
    ((value << 1) ^ (value >> 7)) as u8
}

fn unzigzag(value: u8) -> i8 {
    (value >> 1) as i8 ^ -((value & 1) as i8)
}
