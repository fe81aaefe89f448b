//! Splats: 3D Gaussians, flat or round, as a structure of arrays. Opacities are stored as logits
//! and scales as logarithms, the form in which they are trained and written to files.

/// Value of the spherical harmonic of degree 0, `1 / (2 √π)`. Without higher harmonics, a splat has
/// the colour `rgb = 0.5 + SH_C0 * sh[0]`.
pub const SH_C0: f32 = 0.282_094_8;

/// Smallest accepted squared length of a quaternion. A shorter quaternion counts as zero, which
/// cannot be normalised.
const QUAT_NORM2_MIN: f32 = 1e-12;

/// Bound (exclusive) on the absolute value of a log scale. Within it, the squared scale is a normal
/// `f32` number: neither infinite nor rounded to 0.
const LOG_SCALE_MAX: f32 = 40.0;

/// Number of spherical-harmonic coefficients per colour channel: 1, 4, 9 or 16 for a `degree` of 0,
/// 1, 2 or 3.
pub const fn sh_coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// A set of `n` Gaussians. Every array holds one property of all Gaussians, in the same order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    /// Centres in world units, `[n]` of xyz.
    pub means: Vec<[f32; 3]>,
    /// Rotations `world_from_splat` as quaternions `[n]` of wxyz, any non-zero length.
    pub quats: Vec<[f32; 4]>,
    /// Natural logarithms of the standard deviations along the splat's own axes, `[n]` of 3.
    pub log_scales: Vec<[f32; 3]>,
    /// Opacities as logits, `[n]`: the opacity is `1 / (1 + exp(-logit))`.
    pub opacity_logits: Vec<f32>,
    /// Spherical harmonics, `[n, (sh_degree + 1)², rgb]`, flattened in that order.
    pub sh: Vec<f32>,
    /// Degree of `sh`, 0 to 3.
    pub sh_degree: u32,
}

impl Splats {
    /// An empty set with room for `capacity` splats. Panics if `sh_degree` is above 3.
    pub fn with_capacity(capacity: usize, sh_degree: u32) -> Self {
        assert!(sh_degree <= 3, "sh_degree {sh_degree} is not in 0..=3");
        Self {
            means: Vec::with_capacity(capacity),
            quats: Vec::with_capacity(capacity),
            log_scales: Vec::with_capacity(capacity),
            opacity_logits: Vec::with_capacity(capacity),
            sh: Vec::with_capacity(capacity * 3 * sh_coefficients(sh_degree)),
            sh_degree,
        }
    }

    /// Bytes of memory that a splat takes.
    pub fn bytes_per_splat(sh_degree: u32) -> usize {
        4 * (11 + 3 * sh_coefficients(sh_degree))
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True if there are no splats.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Number of floats in `sh` per splat: `3 (sh_degree + 1)²`.
    pub fn sh_stride(&self) -> usize {
        3 * sh_coefficients(self.sh_degree)
    }

    /// The spherical harmonics of splat `i`, `[(sh_degree + 1)², rgb]`.
    pub fn sh_of(&self, i: usize) -> &[f32] {
        let stride = self.sh_stride();
        &self.sh[i * stride..(i + 1) * stride]
    }

    /// A copy without the splats at the indices `removed`, which must be ascending and unique.
    pub fn without(&self, removed: &[u32]) -> Self {
        let mut kept = Self::with_capacity(self.len() - removed.len(), self.sh_degree);
        let stays = |i: &usize| removed.binary_search(&(*i as u32)).is_err();
        (0..self.len()).filter(stays).for_each(|i| kept.push_from(self, i));
        kept
    }

    /// Appends one splat. Panics unless `sh` has [`Self::sh_stride`] values.
    pub fn push(
        &mut self,
        mean: [f32; 3],
        quat: [f32; 4],
        log_scale: [f32; 3],
        opacity_logit: f32,
        sh: &[f32],
    ) {
        assert_eq!(sh.len(), self.sh_stride(), "sh values per splat");
        self.means.push(mean);
        self.quats.push(quat);
        self.log_scales.push(log_scale);
        self.opacity_logits.push(opacity_logit);
        self.sh.extend_from_slice(sh);
    }

    /// Removes all splats, and keeps their memory for others.
    pub fn clear(&mut self) {
        self.means.clear();
        self.quats.clear();
        self.log_scales.clear();
        self.opacity_logits.clear();
        self.sh.clear();
    }

    /// Removes the last splat. Panics if there is none.
    pub(crate) fn pop(&mut self) {
        let left = self.len() - 1;
        self.means.truncate(left);
        self.quats.truncate(left);
        self.log_scales.truncate(left);
        self.opacity_logits.truncate(left);
        self.sh.truncate(left * self.sh_stride());
    }

    /// Appends splat `i` of `from`. Panics if the SH degrees differ.
    pub fn push_from(&mut self, from: &Self, i: usize) {
        let (mean, quat, log_scale) = (from.means[i], from.quats[i], from.log_scales[i]);
        self.push(mean, quat, log_scale, from.opacity_logits[i], from.sh_of(i));
    }

    /// Appends all splats of `other`. Panics if the SH degrees differ.
    pub fn extend(&mut self, other: &Splats) {
        assert_eq!(self.sh_degree, other.sh_degree, "sh degrees of joined splats");
        self.means.extend_from_slice(&other.means);
        self.quats.extend_from_slice(&other.quats);
        self.log_scales.extend_from_slice(&other.log_scales);
        self.opacity_logits.extend_from_slice(&other.opacity_logits);
        self.sh.extend_from_slice(&other.sh);
    }

    /// Finds the first value that cannot be rendered. Every number must be finite. Every quaternion
    /// must have a length of at least 1e-6 and a finite squared length. Every log scale must lie
    /// between -40 and 40 (both exclusive).
    pub fn find_bad_value(&self) -> Option<BadValue> {
        (0..self.len()).find_map(|splat| self.find_bad_value_of(splat))
    }

    /// Like [`Self::find_bad_value`], for one splat.
    pub fn find_bad_value_of(&self, splat: usize) -> Option<BadValue> {
        let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
        let norm2: f32 = self.quats[splat].iter().map(|v| v * v).sum();
        let checks = [
            ("mean", finite(&self.means[splat])),
            ("quat", norm2.is_finite() && norm2 >= QUAT_NORM2_MIN),
            ("log_scale", self.log_scales[splat].iter().all(|v| v.abs() < LOG_SCALE_MAX)),
            ("opacity_logit", self.opacity_logits[splat].is_finite()),
            ("sh", finite(self.sh_of(splat))),
        ];
        checks.into_iter().find(|(_, good)| !good).map(|(field, _)| BadValue { splat, field })
    }
}

/// A value of a splat that cannot be rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BadValue {
    /// Index of the splat.
    pub splat: usize,
    /// Name of the field in [`Splats`], in the singular, for example `log_scale`.
    pub field: &'static str,
}
