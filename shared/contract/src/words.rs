//! Counts with their nouns, in the texts that people read.

use std::fmt::Display;

/// A count with its noun: `1 splat`, `2 splats`. The plural of `noun` must be the noun with an `s`.
pub fn counted<N: Display + PartialEq + From<u8>>(count: N, noun: &str) -> String {
    let ending = if count == N::from(1u8) { "" } else { "s" };
    format!("{count} {noun}{ending}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_one_is_singular() {
        assert_eq!([0, 1, 21].map(|count: u32| counted(count, "step")), ["0 steps", "1 step", "21 steps"]);
    }
}
