//! Vectors of `f32`, one meaning on every processor: AVX-512, AVX2, NEON or plain Rust, chosen when
//! the program starts, so that nobody needs a compiler flag.
//!
//! A pass writes its inner loop once, as a [`Kernel`] generic over [`Lanes`]; [`Isa::run`] calls it
//! compiled for the chosen instruction set. Everything between `run` and the leaves is
//! `#[inline(always)]`: that is what lets the compiler use the wider instructions there.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod plain;

use std::ops::{Add, Div, Mul, Sub};

pub(crate) use plain::Plain;

/// Lanes of a group: passes work on 16 splats or 16 pixels of a row at a time, in `16 / L::N` vectors.
pub(crate) const GROUP: usize = 16;

/// 16 floats on a cache line of their own.
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

    fn splat(value: f32) -> Self;
    /// Reads the first `N` floats; panics if there are fewer.
    fn load(from: &[f32]) -> Self;
    /// Writes the first `N` floats; panics if there are fewer.
    fn store(self, to: &mut [f32]);
    /// `self * b + c`, fused where the processor can.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// `c - self * b`, fused where the processor can.
    fn neg_mul_add(self, b: Self, c: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn sqrt(self) -> Self;
    fn abs(self) -> Self;
    /// To the nearest integer, ties to even.
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
    /// Bit `i` is lane `i`.
    fn bits(mask: Self::Mask) -> u32;
    /// Sum of the lanes, in an order that is fixed for the instruction set.
    fn sum(self) -> f32;

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

    /// `2^self` for `self` in -126..=127, relative error below 2e-7: the nearest integer goes to the exponent,
    /// the rest through a degree-5 polynomial fitted for least relative error on ±½ (7.5e-8 in exact arithmetic).
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

    /// `e^self`, relative error below `2e-7 + 1e-7 |self|`.
    #[inline(always)]
    fn exp(self) -> Self {
        (self * Self::splat(std::f32::consts::LOG2_E)).exp2()
    }

    /// `ln(1 + self)` for `self` in 0..=1, error below 3e-7: `2 artanh(s)` with `s = x / (2 + x)`, at most 1/3,
    /// as a series up to `s^11`.
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

    /// Lane `i` of the result is the sum of `vectors[i]`; as with [`Lanes::sum`], in a fixed order.
    #[inline(always)]
    fn sums(vectors: &[Self; GROUP]) -> Row {
        let mut row = Row::ZERO;
        for (value, vector) in row.0.iter_mut().zip(vectors) {
            *value = vector.sum();
        }
        row
    }
}

/// Asks for a cache line that will be read soon. Does nothing where we know no instruction for it.
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

/// Work that is written once for every instruction set. `run` must be `#[inline(always)]` and must
/// not hand closures to other threads: those would be compiled without the wider instructions.
pub(crate) trait Kernel {
    type Output;
    fn run<L: Lanes>(self) -> Self::Output;
}

/// An instruction set that this processor has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Isa {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "aarch64")]
    Neon,
    Plain,
}

impl Isa {
    /// Every instruction set of this processor, best first. The last is always `Plain`.
    pub(crate) fn available() -> Vec<Self> {
        let mut found = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if avx512::available() {
                found.push(Self::Avx512);
            }
            if avx2::available() {
                found.push(Self::Avx2);
            }
        }
        #[cfg(target_arch = "aarch64")]
        found.push(Self::Neon);
        found.push(Self::Plain);
        found
    }

    /// The best instruction set of this processor.
    pub(crate) fn best() -> Self {
        Self::available()[0]
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => "avx2",
            #[cfg(target_arch = "aarch64")]
            Self::Neon => "neon",
            Self::Plain => "plain",
        }
    }

    /// Runs `kernel` compiled for this instruction set.
    #[inline]
    #[allow(unsafe_code)]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            // SAFETY: values other than `Plain` come from `available`, which asked the processor.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { avx512::run(kernel) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { avx2::run(kernel) },
            #[cfg(target_arch = "aarch64")]
            Self::Neon => neon::run(kernel),
            Self::Plain => kernel.run::<Plain>(),
        }
    }
}

/// `each!([0, 1, 2], |i| expression of i)` is the array of the expression's values. Not `array::map`: its
/// closure would be a function of its own, compiled without the wider instructions, and measured to cost
/// a call per instruction in the loss.
macro_rules! each {
    ([$($index:literal),*], |$name:ident| $value:expr) => {
        [$({ let $name: usize = $index; $value }),*]
    };
}
pub(crate) use each;

/// Implements the four operators by the named intrinsics.
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation on values that cover signs, ties and the exponential's range.
    struct Everything<'a> {
        a: &'a [f32],
        b: &'a [f32],
    }

    impl Kernel for Everything<'_> {
        type Output = Vec<(&'static str, f32, f32)>;

        #[inline(always)]
        fn run<L: Lanes>(self) -> Self::Output {
            let mut rows = Vec::new();
            let mut out = vec![0.0; L::N];
            for start in (0..self.a.len()).step_by(L::N) {
                let (sa, sb) = (&self.a[start..start + L::N], &self.b[start..start + L::N]);
                let (a, b) = (L::load(sa), L::load(sb));
                type Scalar = fn(f32, f32) -> f32;
                let cases: [(&'static str, L, Scalar); 16] = [
                    ("add", a + b, |a, b| a + b),
                    ("sub", a - b, |a, b| a - b),
                    ("mul", a * b, |a, b| a * b),
                    ("div", a / b, |a, b| a / b),
                    ("mul_add", a.mul_add(b, a), |a, b| a.mul_add(b, a)),
                    ("neg_mul_add", a.neg_mul_add(b, a), |a, b| (-a).mul_add(b, a)),
                    ("min", a.min(b), f32::min),
                    ("max", a.max(b), f32::max),
                    ("sqrt", a.abs().sqrt(), |a, _| a.abs().sqrt()),
                    ("round", a.round(), |a, _| a.round_ties_even()),
                    ("exp", a.exp(), |a, _| f64::from(a).exp() as f32),
                    ("exp2", a.exp2(), |a, _| f64::from(a).exp2() as f32),
                    ("ln_1p", (a * a / (a * a + b * b)).ln_1p(), |a, b| (a * a / (a * a + b * b)).ln_1p()),
                    ("select", L::select(a.lt(b), a, b), |a, b| if a < b { a } else { b }),
                    ("keep", a.keep(a.ge(b)), |a, b| if a >= b { a } else { 0.0 }),
                    ("neg", a.neg(), |a, _| 0.0 - a),
                ];
                for (name, got, expected) in cases {
                    got.store(&mut out);
                    rows.extend((0..L::N).map(|i| (name, out[i], expected(sa[i], sb[i]))));
                }
                rows.push(("sum", a.sum(), sa.iter().sum()));
                let vectors: [L; GROUP] = std::array::from_fn(|i| a * L::splat(i as f32));
                for (i, sum) in L::sums(&vectors).0.into_iter().enumerate() {
                    rows.push(("sum", sum, sa.iter().map(|v| v * i as f32).sum()));
                }
                let expected_bits = (0..L::N).map(|i| u32::from(sa[i] < sb[i]) << i).sum::<u32>();
                rows.push(("bits", L::bits(a.lt(b)) as f32, expected_bits as f32));
                let none = L::and_not(a.lt(b), a.lt(b));
                let same = L::and(a.lt(b), L::mask_all(true));
                rows.push(("any", f32::from(u8::from(L::any(none))), 0.0));
                rows.push(("and", L::bits(same) as f32, expected_bits as f32));
            }
            rows
        }
    }

    #[test]
    fn every_instruction_set_computes_what_scalars_compute() {
        let a: Vec<f32> =
            (0..64).map(|i| (i as f32 - 31.0) * 1.37).chain([0.5, 1.5, -2.5, 80.0].repeat(4)).collect();
        let b: Vec<f32> = (0..80).map(|i| ((i * 37 % 23) as f32 - 11.5) * 0.71).collect();
        for isa in Isa::available() {
            for (name, got, expected) in isa.run(Everything { a: &a, b: &b }) {
                let tolerance = match name {
                    "sum" => 2e-3,
                    "mul_add" | "neg_mul_add" => 2e-5,
                    "exp" => 2e-5 * expected,
                    _ => 4e-7 * expected.abs(),
                };
                assert!(
                    (got - expected).abs() <= tolerance,
                    "{} {name}: {got} is not {expected}",
                    isa.name()
                );
            }
        }
    }
}
