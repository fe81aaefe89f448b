//! The trait [`Lanes`] of vectors, over which kernels are generic, and types and functions that use it.

use std::ops::{Add, Div, Index, IndexMut, Mul, Sub};

/// Number of splats, or of pixels of a row, that passes process at a time, in `16 / L::N` vectors.
pub(crate) const GROUP: usize = 16;

/// 16 floats in one cache line.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Row(pub(crate) [f32; GROUP]);

impl Row {
    pub(crate) const ZERO: Self = Self([0.0; GROUP]);

    /// The `part`-th vector of the row.
    #[inline(always)]
    pub(crate) fn get<L: Lanes>(&self, part: usize) -> L {
        L::load(&self.0[part * L::N..])
    }

    /// Replaces the `part`-th vector of the row.
    #[inline(always)]
    pub(crate) fn set<L: Lanes>(&mut self, part: usize, value: L) {
        value.store(&mut self.0[part * L::N..]);
    }
}

/// A vector of `N` floats; `N` divides [`GROUP`]. Comparisons with NaN are false.
pub(crate) trait Lanes:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    /// Floats in a vector.
    const N: usize;
    /// One truth value per lane.
    type Mask: Copy;
    /// The `16 / N` vectors of a group.
    type Parts: Copy + AsRef<[Self]> + AsMut<[Self]>;

    fn splat(value: f32) -> Self;
    /// Reads the first `N` floats; panics if there are fewer.
    fn load(from: &[f32]) -> Self;
    /// Writes the first `N` floats; panics if there are fewer.
    fn store(self, to: &mut [f32]);
    /// `self * b + c`, rounded once.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// `c - self * b`, rounded once.
    fn neg_mul_add(self, b: Self, c: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn sqrt(self) -> Self;
    fn abs(self) -> Self;
    /// Rounds to the nearest integer, ties to even.
    fn round(self) -> Self;
    /// `self * 2^n` for integer-valued `n` in -126..=127.
    fn scale_by_power_of_2(self, n: Self) -> Self;
    fn lt(self, other: Self) -> Self::Mask;
    fn ge(self, other: Self) -> Self::Mask;
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    fn mask_all(value: bool) -> Self::Mask;
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// `a` and not `b`.
    fn and_not(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn any(mask: Self::Mask) -> bool;
    /// The mask as bits: bit `i` is lane `i`.
    fn bits(mask: Self::Mask) -> u32;
    fn zero_parts() -> Self::Parts;
    /// Sum of a group's 16 floats: each of the first half plus its counterpart in the second, then the same with the
    /// eight sums, the four and the two.
    fn sum(parts: &Self::Parts) -> f32;
    /// Float `i` of the result is the sum of the group `totals[i]`: in each quarter `(a₀ + a₂) + (a₁ + a₃)`, then the
    /// quarters `(q₀ + q₁) + (q₂ + q₃)`. This is the order that takes the fewest instructions.
    fn sums(totals: &[Total<Self>; GROUP]) -> Row;

    /// `a * b + c` of single floats, rounded once.
    #[inline(always)]
    fn fused(a: f32, b: f32, c: f32) -> f32 {
        a.mul_add(b, c)
    }

    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }

    #[inline(always)]
    fn keep(self, mask: Self::Mask) -> Self {
        Self::select(mask, self, Self::zero())
    }

    #[inline(always)]
    fn neg(self) -> Self {
        Self::zero() - self
    }

    /// `2^self` for `self` in -126..=127, with a relative error below 2e-7. The nearest integer `n` becomes the
    /// exponent. A polynomial of degree 5 approximates `2^f` of the remainder `f`; it is fitted for least relative
    /// error on ±½.
    #[inline(always)]
    fn exp2(self) -> Self {
        let n = self.round();
        let f = self - n;
        let c = Self::splat;
        let p = c(0.001_327_647_2).mul_add(f, c(0.009_675_542));
        let p = p.mul_add(f, c(0.055_507_13));
        let p = p.mul_add(f, c(0.240_221_2));
        let p = p.mul_add(f, c(0.693_146_94));
        let p = p.mul_add(f, c(1.000_000_1));
        p.scale_by_power_of_2(n)
    }

    /// `e^self`, with a relative error below `2e-7 + 1e-7 |self|`.
    #[inline(always)]
    fn exp(self) -> Self {
        (self * Self::splat(std::f32::consts::LOG2_E)).exp2()
    }

    /// `ln(1 + x)` for `x = self` in 0..=1, with an error below 3e-7. It is `2 artanh(s)` with `s = x / (2 + x)`, at
    /// most 1/3, computed as a series up to `s^11`.
    #[inline(always)]
    fn ln_1p(self) -> Self {
        let c = Self::splat;
        let s = self / (self + c(2.0));
        let ss = s * s;
        let p = c(2.0 / 11.0).mul_add(ss, c(2.0 / 9.0));
        let p = p.mul_add(ss, c(2.0 / 7.0));
        let p = p.mul_add(ss, c(2.0 / 5.0));
        let p = p.mul_add(ss, c(2.0 / 3.0));
        let p = p.mul_add(ss, c(2.0));
        p * s
    }
}

/// The sum of many groups: 16 floats, of which the first is the sum of the first floats of all groups, and so on.
/// `total[part]` is their `part`-th vector. [`Total::sum`] adds the 16 in the same order on every instruction set.
#[derive(Clone, Copy)]
pub(crate) struct Total<L: Lanes>(pub(super) L::Parts);

impl<L: Lanes> Total<L> {
    #[inline(always)]
    pub(crate) fn zero() -> Self {
        Self(L::zero_parts())
    }

    #[inline(always)]
    pub(crate) fn sum(&self) -> f32 {
        L::sum(&self.0)
    }
}

impl<L: Lanes> Index<usize> for Total<L> {
    type Output = L;

    #[inline(always)]
    fn index(&self, part: usize) -> &L {
        &self.0.as_ref()[part]
    }
}

impl<L: Lanes> IndexMut<usize> for Total<L> {
    #[inline(always)]
    fn index_mut(&mut self, part: usize) -> &mut L {
        &mut self.0.as_mut()[part]
    }
}

/// Prefetches a cache line that will be read soon. Does nothing on processors other than x86-64.
#[inline(always)]
#[allow(unsafe_code)]
pub(crate) fn prefetch<T>(slice: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if index < slice.len() {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint; the address is inside the slice.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(slice.as_ptr().add(index).cast()) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (slice, index);
}

/// Work that is compiled for every instruction set. `run` must be `#[inline(always)]`. It must not pass closures to
/// other threads, because the closures would be compiled for the baseline instruction set.
pub(crate) trait Kernel {
    type Output;
    fn run<L: Lanes>(self) -> Self::Output;
}

/// `a · b`.
#[inline(always)]
pub(crate) fn dot3<L: Lanes>(a: [L; 3], b: [L; 3]) -> L {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

/// `a × b`.
#[inline(always)]
pub(crate) fn cross3<L: Lanes>(a: [L; 3], b: [L; 3]) -> [L; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `each!([0, 1, 2], |i| expression of i)` is the array of the values of the expression. The closure of `array::map`
/// would be a separate function, compiled for the baseline instruction set, so each intrinsic in it would become a
/// call.
macro_rules! each {
    ([$($index:literal),*], |$name:ident| $value:expr) => {
        [$({ let $name: usize = $index; $value }),*]
    };
}
pub(crate) use each;

/// Implements `+`, `-`, `*` and `/` of a vector with the given intrinsics.
#[allow(unused_macros)]
macro_rules! operators {
    ($vector:ident, $add:ident, $sub:ident, $mul:ident, $div:ident) => {
        operators!(@one $vector, Add, add, $add);
        operators!(@one $vector, Sub, sub, $sub);
        operators!(@one $vector, Mul, mul, $mul);
        operators!(@one $vector, Div, div, $div);
    };
    (@one $vector:ident, $trait:ident, $method:ident, $intrinsic:ident) => {
        impl std::ops::$trait for $vector {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                // SAFETY: this type is only used by kernels that `Isa::run` started after asking the processor.
                Self(unsafe { $intrinsic(self.0, other.0) })
            }
        }
    };
}
#[allow(unused_imports)]
pub(crate) use operators;
