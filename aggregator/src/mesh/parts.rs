//! Divides the blocks into parts that are fused one after the other.

use std::ops::Range;

use glam::IVec3;

use super::volume::Key;

/// Blocks that are fused at the same time.
#[derive(Debug, PartialEq)]
pub(super) struct Part {
    /// Keys of the part's own blocks, then of those of later parts that border on them; ascending.
    pub(super) keys: Vec<Key>,
    /// Number of the part's own blocks.
    pub(super) own: usize,
}

/// Divides blocks, of which `keys` ascend, into parts of at most `blocks_max` blocks with those that border on them. A part
/// has more only if a single block and its neighbours are more.
pub(super) fn divide(keys: &[Key], blocks_max: usize) -> Vec<Range<usize>> {
    let mut parts = Vec::new();
    let mut from = 0;
    while from < keys.len() {
        let mut own = (keys.len() - from).min(blocks_max).max(1);
        loop {
            let blocks = own + borders(keys, from..from + own).len();
            if blocks <= blocks_max || own == 1 {
                break;
            }
            // A smaller part has fewer neighbours too, but not in the same ratio.
            own = (own * blocks_max / blocks).min(own - own.div_ceil(32)).max(1);
        }
        parts.push(from..from + own);
        from += own;
    }
    parts
}

/// The part with these own blocks.
pub(super) fn part(keys: &[Key], own: Range<usize>) -> Part {
    let mut with_borders = keys[own.clone()].to_vec();
    with_borders.extend(borders(keys, own.clone()));
    Part { keys: with_borders, own: own.len() }
}

/// Keys of the blocks after `own` that border on one of them, ascending. Extraction needs the neighbours towards +x, +y and
/// +z, which all come later.
fn borders(keys: &[Key], own: Range<usize>) -> Vec<Key> {
    let (mine, later) = (&keys[own.clone()], &keys[own.end..]);
    if later.is_empty() {
        return Vec::new();
    }
    let neighbours = |key: &Key| {
        let block = key.block();
        (1..8)
            .filter_map(move |corner| Key::new(block + IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2)))
    };
    let is_later = |key: &Key| *key >= later[0] && later.binary_search(key).is_ok();
    let mut found: Vec<Key> = mine.iter().flat_map(neighbours).filter(is_later).collect();
    found.sort_unstable();
    found.dedup();
    found
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Level ground of 40 × 30 blocks, two blocks high.
    fn ground() -> Vec<Key> {
        let block = |i: i32| IVec3::new(i % 40 - 17, i / 40 % 30 - 4, i / 1200);
        let mut keys: Vec<Key> = (0..2400).map(|i| Key::new(block(i)).unwrap()).collect();
        keys.sort_unstable();
        keys
    }

    #[test]
    fn parts_hold_every_block_once_and_their_neighbours() {
        let keys = ground();
        for blocks_max in [8, 100, 1000, 2400] {
            let parts = divide(&keys, blocks_max);
            assert!(parts.iter().cloned().flatten().eq(0..keys.len()), "{blocks_max}");
            for own in parts {
                let part = part(&keys, own.clone());
                assert!(part.keys.len() <= blocks_max || part.own == 1, "{blocks_max}");
                assert!(part.keys.is_sorted() && part.keys[..part.own] == keys[own]);
                for key in &part.keys[..part.own] {
                    for corner in 1..8 {
                        let step = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2);
                        let neighbour = Key::new(key.block() + step).unwrap();
                        assert_eq!(
                            part.keys.binary_search(&neighbour).is_ok(),
                            keys.binary_search(&neighbour).is_ok(),
                        );
                    }
                }
            }
        }
        assert_eq!(divide(&keys, 2400).len(), 1);
        assert!(divide(&keys, 1000).len() <= 4, "{:?}", divide(&keys, 1000));
    }

    #[test]
    fn a_key_gives_its_block() {
        for block in [IVec3::new(0, 0, 0), IVec3::new(-7, 300_001, -90_000), IVec3::splat((1 << 20) - 1)] {
            assert_eq!(Key::new(block).unwrap().block(), block);
        }
        assert_eq!(Key::new(IVec3::new(1 << 20, 0, 0)), None);
    }
}
