//! View-dependent spherical harmonics, quantised to integer steps along the directions of a basis
//! ([`super::basis`]).

use super::error::BodyError;
use super::limits::sh_rest;

/// Byte layout of the view-dependent spherical harmonics of a splat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ShLayout {
    /// Number of directions that are stored: those with the largest variance.
    pub components: u8,
    /// Number of leading directions that take one byte each (-128 to 127 steps). The other directions take
    /// half a byte each (-8 to 7 steps).
    pub wide: u8,
}

impl ShLayout {
    /// The layout of a model without view-dependent colour.
    pub const NONE: Self = Self { components: 0, wide: 0 };

    /// Checks that spherical harmonics of this degree can have the layout.
    pub fn check(self, sh_degree: u8) -> Result<Self, BodyError> {
        let is_sane = self.wide <= self.components && usize::from(self.components) <= sh_rest(sh_degree);
        is_sane.then_some(self).ok_or(BodyError::BadPack)
    }

    /// Bytes per splat before compression.
    pub fn splat_bytes(self) -> usize {
        usize::from(self.wide) + usize::from(self.components - self.wide).div_ceil(2)
    }

    /// Clamps `steps` to the range that the direction `component` can store.
    pub fn clamp(self, component: usize, steps: i32) -> i8 {
        let is_wide = component < usize::from(self.wide);
        (if is_wide { steps.clamp(-128, 127) } else { steps.clamp(-8, 7) }) as i8
    }

    /// Encodes the `steps` of n splats (shape `[n, components]`) into [`Self::splat_bytes`] planes of n
    /// bytes each.
    ///
    /// # Panics
    /// If the lengths do not match.
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

    /// Decodes the steps of one splat along the direction `component`. The splat is number `i` of the `n`
    /// in `planes`.
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
