//! A set of chunk indices, stored as bits.

/// A set of numbers below a fixed count. Each number takes one bit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct BitSet {
    words: Vec<u64>,
    ones: u32,
}

impl BitSet {
    /// The empty set, with room for `0..count`.
    pub(crate) fn empty(count: u32) -> Self {
        Self { words: vec![0; count.div_ceil(64) as usize], ones: 0 }
    }

    /// The set `0..count`.
    pub(crate) fn full(count: u32) -> Self {
        let mut set = Self::empty(count);
        (0..count).for_each(|i| set.insert(i));
        set
    }

    pub(crate) fn contains(&self, i: u32) -> bool {
        self.words[i as usize / 64] >> (i % 64) & 1 == 1
    }

    pub(crate) fn insert(&mut self, i: u32) {
        self.ones += u32::from(!self.contains(i));
        self.words[i as usize / 64] |= 1 << (i % 64);
    }

    pub(crate) fn remove(&mut self, i: u32) {
        self.ones -= u32::from(self.contains(i));
        self.words[i as usize / 64] &= !(1 << (i % 64));
    }

    /// Number of elements.
    pub(crate) fn len(&self) -> u32 {
        self.ones
    }

    /// The smallest element that is not in `other`, which has the same count.
    pub(crate) fn first_outside(&self, other: &Self) -> Option<u32> {
        let outside = |(word, other): (&u64, &u64)| word & !other;
        let (word, bits) =
            self.words.iter().zip(&other.words).map(outside).enumerate().find(|(_, bits)| *bits != 0)?;
        Some(word as u32 * 64 + bits.trailing_zeros())
    }

    /// The smallest element.
    pub(crate) fn first(&self) -> Option<u32> {
        let word = self.words.iter().position(|word| *word != 0)?;
        Some(word as u32 * 64 + self.words[word].trailing_zeros())
    }
}
