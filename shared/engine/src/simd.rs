//! Vectors of `f32` with the same operations on every processor, implemented with AVX-512, AVX2, NEON or plain Rust.
//! The instruction set is chosen at run time, so no compiler flag is needed.
//!
//! Every instruction set gives the same bits: each operation is rounded once, as IEEE 754 says, multiplication and
//! addition are fused everywhere, and sums over lanes and groups have one order ([`Total`]).
//!
//! A pass writes its inner loop once, as a [`Kernel`] that is generic over [`Lanes`]. [`Isa::run`] calls the version
//! that is compiled for the chosen instruction set. All functions between `run` and the intrinsics must be
//! `#[inline(always)]`; otherwise they would be compiled for the baseline instruction set of the target.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod isa;
mod lanes;
#[cfg(target_arch = "aarch64")]
mod neon;
mod plain;
#[cfg(test)]
mod tests;

pub(crate) use isa::Isa;
pub(crate) use lanes::{GROUP, Kernel, Lanes, Row, Total, cross3, dot3, each, prefetch};
pub(crate) use plain::Plain;
