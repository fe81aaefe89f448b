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
mod isa;
mod lanes;
#[cfg(target_arch = "aarch64")]
mod neon;
mod plain;
#[cfg(test)]
mod tests;

pub(crate) use isa::Isa;
pub(crate) use lanes::{GROUP, Kernel, Lanes, Row, cross3, dot3, each, prefetch};
pub(crate) use plain::Plain;
