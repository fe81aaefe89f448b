//! Random numbers that depend only on the seed, their purpose and two indices, such as step and view. A checkpoint thus
//! needs no state of a generator, and a resumed run draws the same numbers.

/// The purpose of a random number.
#[derive(Clone, Copy)]
pub(crate) enum Purpose {
    /// The order of views in an epoch.
    ViewOrder = 1,
    /// Data of tests.
    #[cfg(test)]
    Test = 2,
    /// The neighbour that a view is compared with.
    Neighbour = 3,
    /// The pixels that a step compares with the neighbour.
    Sample = 4,
}

/// A stream of numbers (SplitMix64).
pub(crate) struct Random(u64);

impl Random {
    /// The stream of a seed and a purpose. `a` and `b` are two indices, for example step and view.
    pub(crate) fn new(seed: u64, purpose: Purpose, a: u64, b: u64) -> Self {
        let mut mixed = Self(seed ^ (purpose as u64) << 56);
        let first = mixed.next_u64() ^ a;
        let mut mixed = Self(first);
        let second = mixed.next_u64() ^ b;
        Self(second)
    }

    pub(crate) fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in 0..n, for n below 2³².
    pub(crate) fn below(&mut self, n: u64) -> u64 {
        ((self.next_u64() >> 32) * n) >> 32
    }
}

/// What the data of tests are drawn with.
#[cfg(test)]
impl Random {
    /// Uniform in 0..=1, but never 0, so that its logarithm is finite.
    fn unit(&mut self) -> f64 {
        ((self.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    /// Normally distributed, mean 0, standard deviation 1 (Box–Muller).
    pub(crate) fn normal(&mut self) -> f32 {
        let radius = (-2.0 * libm::log(self.unit())).sqrt();
        (radius * libm::cos(std::f64::consts::TAU * self.unit())) as f32
    }
}
