//! Vectors of eight `f32` in plain Rust, for processors without AVX-512, AVX2 or NEON, and for tests.

use super::lanes::{GROUP, Lanes, Row, Total};

/// Eight floats, compiled for the instruction set that every processor of the target has.
#[derive(Clone, Copy)]
pub(crate) struct Plain([f32; 8]);

#[inline(always)]
fn zip(a: Plain, b: Plain, f: impl Fn(f32, f32) -> f32) -> Plain {
    Plain(std::array::from_fn(|i| f(a.0[i], b.0[i])))
}

macro_rules! operator {
    ($trait:ident, $method:ident, $op:tt) => {
        impl std::ops::$trait for Plain {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                zip(self, other, |a, b| a $op b)
            }
        }
    };
}
operator!(Add, add, +);
operator!(Sub, sub, -);
operator!(Mul, mul, *);
operator!(Div, div, /);

/// `a * b + c`, rounded once. `f32::mul_add` would call a function of the system for each lane here. In `f64` the product is
/// exact, but the sum is not always, and rounding it twice can give another result. So if digits of the sum were lost, its
/// last bit is set, and the second rounding cannot mistake it for a tie ("round to odd": S. Boldo and G. Melquiond, "Emulation
/// of a FMA and Correctly Rounded Sums", IEEE Transactions on Computers 57, 2008).
#[inline(always)]
fn fused(a: f32, b: f32, c: f32) -> f32 {
    let (product, c) = (f64::from(a) * f64::from(b), f64::from(c));
    let sum = product + c;
    let of_c = sum - product;
    let error = (product - (sum - of_c)) + (c - of_c);
    let bits = sum.to_bits();
    // False for infinities and NaN, whose error is NaN.
    let is_inexact_and_even = error.abs() > 0.0 && bits & 1 == 0;
    let is_larger = (error > 0.0) == (sum > 0.0);
    let odd = if is_larger { bits.wrapping_add(1) } else { bits.wrapping_sub(1) };
    f64::from_bits(if is_inexact_and_even { odd } else { bits }) as f32
}

impl Lanes for Plain {
    const N: usize = 8;
    type Mask = [bool; 8];
    type Parts = [Self; 2];

    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; 8])
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from = &from[..8];
        Self(std::array::from_fn(|i| from[i]))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        to[..8].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        Self(std::array::from_fn(|i| fused(self.0[i], b.0[i], c.0[i])))
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self(std::array::from_fn(|i| fused(-self.0[i], b.0[i], c.0[i])))
    }
    #[inline(always)]
    fn fused(a: f32, b: f32, c: f32) -> f32 {
        fused(a, b, c)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        zip(self, other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        zip(self, other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.map(f32::abs))
    }
    // Adding and subtracting 1.5 × 2^23 rounds magnitudes below 2^22 to an integer.
    #[inline(always)]
    fn round(self) -> Self {
        const MAGIC: f32 = 12_582_912.0;
        Self(self.0.map(|a| (a + MAGIC) - MAGIC))
    }
    #[inline(always)]
    fn scale_by_power_of_2(self, n: Self) -> Self {
        zip(self, n, |a, n| a * f32::from_bits(((n as i32 + 127) as u32) << 23))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        std::array::from_fn(|i| self.0[i] < other.0[i])
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        std::array::from_fn(|i| self.0[i] >= other.0[i])
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(std::array::from_fn(|i| if mask[i] { yes.0[i] } else { no.0[i] }))
    }
    #[inline(always)]
    fn mask_all(value: bool) -> Self::Mask {
        [value; 8]
    }
    #[inline(always)]
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|i| a[i] & b[i])
    }
    #[inline(always)]
    fn and_not(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|i| a[i] & !b[i])
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        mask.iter().fold(false, |any, lane| any | lane)
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u32 {
        (0..8).fold(0, |bits, i| bits | (u32::from(mask[i]) << i))
    }
    #[inline(always)]
    fn zero_parts() -> Self::Parts {
        [Self::zero(); 2]
    }
    #[inline(always)]
    fn sum([a, b]: &Self::Parts) -> f32 {
        let eight = (*a + *b).0;
        let four: [f32; 4] = std::array::from_fn(|i| eight[i] + eight[i + 4]);
        (four[0] + four[2]) + (four[1] + four[3])
    }
    #[inline(always)]
    fn sums(totals: &[Total<Self>; GROUP]) -> Row {
        let quarter = |a: &[f32]| (a[0] + a[2]) + (a[1] + a[3]);
        let half = |part: &Self| quarter(&part.0[..4]) + quarter(&part.0[4..]);
        Row(std::array::from_fn(|i| half(&totals[i][0]) + half(&totals[i][1])))
    }
}
