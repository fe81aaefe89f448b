//! Vectors of eight `f32`, with AVX2 and FMA.

#![allow(unsafe_code)]

use std::arch::x86_64::*;

use super::lanes::{GROUP, Kernel, Lanes, Row, Total, operators};

#[derive(Clone, Copy)]
pub(crate) struct Avx2(__m256);

pub(super) fn available() -> bool {
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") && is_x86_feature_detected!("bmi2")
}

/// # Safety
/// [`available`] must have returned true.
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
pub(super) unsafe fn run<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Avx2>()
}

/// The sum of a vector, as the last three steps of [`Lanes::sum`].
///
/// # Safety
/// [`available`] must have returned true.
#[inline(always)]
pub(super) unsafe fn sum_of_eight(eight: __m256) -> f32 {
    // SAFETY: see above.
    unsafe {
        let four = _mm_add_ps(_mm256_castps256_ps128(eight), _mm256_extractf128_ps::<1>(eight));
        let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
        _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
    }
}

operators!(Avx2, _mm256_add_ps, _mm256_sub_ps, _mm256_mul_ps, _mm256_div_ps);

// SAFETY (every block below): only kernels that `Isa::run` calls use this type, on processors that support it; loads
// and stores go through slices whose length is checked first.
impl Lanes for Avx2 {
    const N: usize = 8;
    type Mask = __m256;
    type Parts = [Self; 2];

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_set1_ps(value) })
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from = &from[..8];
        // SAFETY: see above.
        Self(unsafe { _mm256_loadu_ps(from.as_ptr()) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to = &mut to[..8];
        // SAFETY: see above.
        unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_fmadd_ps(self.0, b.0, c.0) })
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_fnmadd_ps(self.0, b.0, c.0) })
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_min_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_max_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_sqrt_ps(self.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    fn round(self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(self.0) })
    }
    #[inline(always)]
    fn scale_by_power_of_2(self, n: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe {
            let exponent =
                _mm256_slli_epi32::<23>(_mm256_add_epi32(_mm256_cvtps_epi32(n.0), _mm256_set1_epi32(127)));
            _mm256_mul_ps(self.0, _mm256_castsi256_ps(exponent))
        })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        // SAFETY: see above.
        unsafe { _mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0) }
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        // SAFETY: see above.
        unsafe { _mm256_cmp_ps::<_CMP_GE_OQ>(self.0, other.0) }
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_blendv_ps(no.0, yes.0, mask) })
    }
    #[inline(always)]
    fn keep(self, mask: Self::Mask) -> Self {
        // SAFETY: see above.
        Self(unsafe { _mm256_and_ps(self.0, mask) })
    }
    #[inline(always)]
    fn mask_all(value: bool) -> Self::Mask {
        // SAFETY: see above.
        unsafe { _mm256_castsi256_ps(_mm256_set1_epi32(if value { -1 } else { 0 })) }
    }
    #[inline(always)]
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        // SAFETY: see above.
        unsafe { _mm256_and_ps(a, b) }
    }
    #[inline(always)]
    fn and_not(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        // SAFETY: see above.
        unsafe { _mm256_andnot_ps(b, a) }
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        Self::bits(mask) != 0
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u32 {
        // SAFETY: see above.
        unsafe { _mm256_movemask_ps(mask) as u32 }
    }
    #[inline(always)]
    fn zero_parts() -> Self::Parts {
        [Self::zero(); 2]
    }
    #[inline(always)]
    fn sum([a, b]: &Self::Parts) -> f32 {
        // SAFETY: see above.
        unsafe { sum_of_eight((*a + *b).0) }
    }

    #[inline(always)]
    fn sums(totals: &[Total<Self>; GROUP]) -> Row {
        let mut row = Row::ZERO;
        for k in [0, 8] {
            // SAFETY: see above.
            let [a, b] = unsafe { [sums_of_eight(totals, k, 0), sums_of_eight(totals, k, 1)] };
            (Self(a) + Self(b)).store(&mut row.0[k..]);
        }
        row
    }
}

// [`Lanes::sums`] uses these functions instead of closures. A closure is compiled for the baseline instruction set, so each
// intrinsic in it was a call, and a training took a third longer.

/// Each lane is the sum of one of the eight vectors `totals[k..k + 8]`, of which `part` is taken.
///
/// # Safety
/// [`available`] must have returned true.
#[inline(always)]
unsafe fn sums_of_eight(totals: &[Total<Avx2>; GROUP], k: usize, part: usize) -> __m256 {
    // SAFETY: see above.
    unsafe {
        let (a, b) = (sums_of_four(totals, k, part), sums_of_four(totals, k + 4, part));
        _mm256_add_ps(_mm256_permute2f128_ps::<0x20>(a, b), _mm256_permute2f128_ps::<0x31>(a, b))
    }
}

/// Partial sums of the four vectors `totals[k..k + 4]`, of which `part` is taken. Lane `i` of each half belongs to the `i`-th
/// vector; both halves are still to be added.
///
/// # Safety
/// [`available`] must have returned true.
#[inline(always)]
unsafe fn sums_of_four(totals: &[Total<Avx2>; GROUP], k: usize, part: usize) -> __m256 {
    // SAFETY: see above.
    unsafe {
        let a = sums_of_two(totals[k][part].0, totals[k + 1][part].0);
        let b = sums_of_two(totals[k + 2][part].0, totals[k + 3][part].0);
        let (a, b) = (_mm256_castps_pd(a), _mm256_castps_pd(b));
        let (low, high) = (_mm256_unpacklo_pd(a, b), _mm256_unpackhi_pd(a, b));
        _mm256_add_ps(_mm256_castpd_ps(low), _mm256_castpd_ps(high))
    }
}

/// Interleaves the lanes of two vectors and adds them.
///
/// # Safety
/// [`available`] must have returned true.
#[inline(always)]
unsafe fn sums_of_two(a: __m256, b: __m256) -> __m256 {
    // SAFETY: see above.
    unsafe { _mm256_add_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b)) }
}
