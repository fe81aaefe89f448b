//! Vectors of four `f32`, with NEON, which every 64-bit ARM processor has.

#![allow(unsafe_code)]

use std::arch::aarch64::*;

use super::lanes::{GROUP, Kernel, Lanes, Row, Total, operators};

#[derive(Clone, Copy)]
pub(crate) struct Neon(float32x4_t);

pub(super) fn run<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Neon>()
}

operators!(Neon, vaddq_f32, vsubq_f32, vmulq_f32, vdivq_f32);

// SAFETY (every block below): NEON is part of the aarch64 baseline; loads and stores go through slices
// whose length is checked first.
impl Lanes for Neon {
    const N: usize = 4;
    type Mask = uint32x4_t;
    type Parts = [Self; 4];

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see above.
        Self(unsafe { vdupq_n_f32(value) })
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from = &from[..4];
        // SAFETY: see above.
        Self(unsafe { vld1q_f32(from.as_ptr()) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to = &mut to[..4];
        // SAFETY: see above.
        unsafe { vst1q_f32(to.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { vfmaq_f32(c.0, self.0, b.0) })
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { vfmsq_f32(c.0, self.0, b.0) })
    }
    // If one operand is NaN, these selects return the second operand, as x86 does. `vminnm` and `vmaxnm` would return
    // the operand that is a number.
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::select(self.lt(other), self, other)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::select(other.lt(self), self, other)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        // SAFETY: see above.
        Self(unsafe { vsqrtq_f32(self.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: see above.
        Self(unsafe { vabsq_f32(self.0) })
    }
    #[inline(always)]
    fn round(self) -> Self {
        // SAFETY: see above.
        Self(unsafe { vrndnq_f32(self.0) })
    }
    #[inline(always)]
    fn scale_by_power_of_2(self, n: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe {
            let exponent = vshlq_n_s32::<23>(vaddq_s32(vcvtnq_s32_f32(n.0), vdupq_n_s32(127)));
            vmulq_f32(self.0, vreinterpretq_f32_s32(exponent))
        })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        // SAFETY: see above.
        unsafe { vcltq_f32(self.0, other.0) }
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        // SAFETY: see above.
        unsafe { vcgeq_f32(self.0, other.0) }
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        // SAFETY: see above.
        Self(unsafe { vbslq_f32(mask, yes.0, no.0) })
    }
    #[inline(always)]
    fn mask_all(value: bool) -> Self::Mask {
        // SAFETY: see above.
        unsafe { vdupq_n_u32(if value { !0 } else { 0 }) }
    }
    #[inline(always)]
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        // SAFETY: see above.
        unsafe { vandq_u32(a, b) }
    }
    #[inline(always)]
    fn and_not(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        // SAFETY: see above.
        unsafe { vbicq_u32(a, b) }
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        // SAFETY: see above.
        unsafe { vmaxvq_u32(mask) != 0 }
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u32 {
        const LANES: [u32; 4] = [1, 2, 4, 8];
        // SAFETY: see above.
        unsafe { vaddvq_u32(vandq_u32(mask, vld1q_u32(LANES.as_ptr()))) }
    }
    #[inline(always)]
    fn zero_parts() -> Self::Parts {
        [Self::zero(); 4]
    }
    #[inline(always)]
    fn sum([a, b, c, d]: &Self::Parts) -> f32 {
        let four = (*a + *c) + (*b + *d);
        // SAFETY: see above.
        unsafe {
            let two = vadd_f32(vget_low_f32(four.0), vget_high_f32(four.0));
            vget_lane_f32::<0>(two) + vget_lane_f32::<1>(two)
        }
    }

    /// Interleaves the lanes of two vectors and adds them, then does the same with two of the results.
    #[inline(always)]
    fn sums(totals: &[Total<Self>; GROUP]) -> Row {
        // SAFETY: see above.
        let pair = |a: Self, b: Self| unsafe { vaddq_f32(vzip1q_f32(a.0, b.0), vzip2q_f32(a.0, b.0)) };
        let quad = |k: usize, part: usize| {
            let v = |i: usize| totals[k + i][part];
            // SAFETY: see above.
            Self(unsafe {
                let a = vreinterpretq_f64_f32(pair(v(0), v(1)));
                let b = vreinterpretq_f64_f32(pair(v(2), v(3)));
                let (low, high) = (vzip1q_f64(a, b), vzip2q_f64(a, b));
                vaddq_f32(vreinterpretq_f32_f64(low), vreinterpretq_f32_f64(high))
            })
        };
        let mut row = Row::ZERO;
        for k in [0, 4, 8, 12] {
            let sums = (quad(k, 0) + quad(k, 1)) + (quad(k, 2) + quad(k, 3));
            sums.store(&mut row.0[k..]);
        }
        row
    }
}
