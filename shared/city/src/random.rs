//! Seeded random numbers: a generator for building, and an integer hash for textures.
//!
//! Uses only integer arithmetic and exactly rounded floating-point operations, so that the same seed
//! gives the same city on every machine.

/// SplitMix64 (Steele, Lea, Flood 2014): a counter and a mixer that pass BigCrush.
#[derive(Clone, Debug)]
pub(super) struct Rng(u64);

const GOLDEN_GAMMA: u64 = 0x9e37_79b9_7f4a_7c15;

impl Rng {
    /// A generator for one purpose: the same seed with another `purpose` gives unrelated numbers.
    pub(super) fn new(seed: u64, purpose: u64) -> Self {
        let mut rng = Self(seed ^ purpose.wrapping_mul(GOLDEN_GAMMA));
        rng.0 = rng.next_u64() ^ purpose;
        rng
    }

    /// The next 64 random bits.
    pub(super) fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(GOLDEN_GAMMA);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A seed for a texture.
    pub(super) fn seed(&mut self) -> u32 {
        (self.next_u64() >> 32) as u32
    }

    /// Uniform in `[0, 1)`.
    pub(super) fn unit(&mut self) -> f32 {
        (self.next_u64() >> 40) as f32 * (1.0 / 16_777_216.0)
    }

    /// Uniform in `[0, 1)`, with all bits of a double.
    pub(super) fn unit_f64(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Uniform in `[low, high)`.
    pub(super) fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Uniform in `[-1, 1)`.
    pub(super) fn signed(&mut self) -> f32 {
        self.range(-1.0, 1.0)
    }

    /// Uniform in `0..count`; `count` is at least 1.
    pub(super) fn index(&mut self, count: usize) -> usize {
        (((self.next_u64() >> 32) * count as u64) >> 32) as usize
    }

    /// True with this probability.
    pub(super) fn chance(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    /// A uniformly chosen item of `of`, which must not be empty.
    pub(super) fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.index(of.len())]
    }

    /// Nearly normal with mean 0 and standard deviation 1: the sum of twelve uniform numbers minus six.
    /// This avoids the platform's logarithm.
    pub(super) fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit_f64()).sum::<f64>() - 6.0
    }
}

/// A hash of a lattice point: 32 well-mixed bits.
#[inline]
pub(super) fn hash2(x: i32, y: i32, seed: u32) -> u32 {
    let h = seed ^ (x as u32).wrapping_mul(0x8da6_b343) ^ (y as u32).wrapping_mul(0xd816_3841);
    let h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    let h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^ (h >> 15)
}

/// A hash of a lattice point as a number in `[0, 1)`.
#[inline]
pub(super) fn unit2(x: i32, y: i32, seed: u32) -> f32 {
    (hash2(x, y, seed) >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// The largest integer not above `x`, for `|x|` below 2³¹. Cheaper than the library's `floor` on
/// processors without an instruction for it.
#[inline]
pub(super) fn floor_i32(x: f32) -> i32 {
    let whole = x as i32;
    whole - i32::from((whole as f32) > x)
}

/// The fractional part of `x` above its floor, in `[0, 1]`.
#[inline]
pub(super) fn fraction(x: f32) -> f32 {
    x - floor_i32(x) as f32
}
