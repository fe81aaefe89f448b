//! The records of splat–tile pairs, divided among threads by tiles.

use super::bin::TileLists;
use crate::simd::Row;

/// What a pass over the tile lists leaves for one splat–tile pair.
pub(crate) type Record = Row;

/// Tiles that are not divided any more.
const TILES_AT_ONCE: usize = 4;

/// Makes `records` as long as there are pairs, and calls `work(tile, records of its list)` for every tile, in parallel.
pub(crate) fn for_each_tile(
    lists: &TileLists,
    records: &mut Vec<Record>,
    work: impl Fn(usize, &mut [Record]) + Sync,
) {
    records.resize(lists.pairs(), Row::ZERO);
    divide(0, lists.starts(), records, &work);
}

/// Tiles `first..first + starts.len() - 1`; `starts` are those of their records, counted from any origin.
fn divide(
    first: usize,
    starts: &[u32],
    mut records: &mut [Record],
    work: &(impl Fn(usize, &mut [Record]) + Sync),
) {
    let tiles = starts.len().saturating_sub(1);
    if tiles > TILES_AT_ONCE {
        let middle = tiles / 2;
        let (left, right) = records.split_at_mut((starts[middle] - starts[0]) as usize);
        rayon::join(
            || divide(first, &starts[..=middle], left, work),
            || divide(first + middle, &starts[middle..], right, work),
        );
        return;
    }
    for (tile, pair) in (first..).zip(starts.windows(2)) {
        let (own, others) = std::mem::take(&mut records).split_at_mut((pair[1] - pair[0]) as usize);
        records = others;
        work(tile, own);
    }
}
