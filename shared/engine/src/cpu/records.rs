//! The records of splat–tile pairs. The work on them is divided among threads by tiles.

use super::bin::TileLists;
use crate::simd::Row;

/// The result of a pass over tile lists for one splat–tile pair.
pub(crate) type Record = Row;

/// Number of pieces of about equal work for each thread. Because there are several, fast threads can process more of
/// them than slow ones.
const PIECES_PER_THREAD: usize = 8;

/// Resizes `records` to one for each pair, and calls `work(tile, records of the tile's list)` for every tile, in
/// parallel.
pub(crate) fn for_each_tile(
    lists: &TileLists,
    records: &mut Vec<Record>,
    work: impl Fn(usize, &mut [Record]) + Sync,
) {
    records.resize(lists.pairs(), Row::ZERO);
    let piece = lists.pairs() / (PIECES_PER_THREAD * rayon::current_num_threads());
    divide(0, lists.starts(), records, piece, &work);
}

/// Calls `work` for the tiles from `first` on. Tile `first + i` has the records `starts[i]..starts[i + 1]`, counted
/// from `starts[0]`. The tiles are divided in two, for parallel work, until one tile or at most `piece` records are
/// left.
fn divide(
    first: usize,
    starts: &[u32],
    mut records: &mut [Record],
    piece: usize,
    work: &(impl Fn(usize, &mut [Record]) + Sync),
) {
    let tiles = starts.len().saturating_sub(1);
    if tiles > 1 && records.len() > piece {
        let half = starts[0] + records.len() as u32 / 2;
        let middle = starts.partition_point(|start| *start <= half).clamp(1, tiles - 1);
        let (left, right) = records.split_at_mut((starts[middle] - starts[0]) as usize);
        rayon::join(
            || divide(first, &starts[..=middle], left, piece, work),
            || divide(first + middle, &starts[middle..], right, piece, work),
        );
        return;
    }
    for (tile, pair) in (first..).zip(starts.windows(2)) {
        let (own, others) = std::mem::take(&mut records).split_at_mut((pair[1] - pair[0]) as usize);
        records = others;
        work(tile, own);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each tile adds its number to its records. The lists have very different lengths, and some are empty.
    #[test]
    fn every_tile_gets_its_own_records() {
        let lengths = [0u32, 3, 0, 0, 100, 1, 1, 7, 0, 2, 0];
        let starts: Vec<u32> = std::iter::once(0)
            .chain(lengths.iter().scan(0, |sum, length| {
                *sum += length;
                Some(*sum)
            }))
            .collect();
        for piece in [0, 1, 5, 1000] {
            let mut records = vec![Row::ZERO; 114];
            divide(0, &starts, &mut records, piece, &|tile, own| {
                assert_eq!(own.len(), lengths[tile] as usize);
                own.iter_mut().for_each(|record| record.0[0] += tile as f32);
            });
            for (tile, pair) in starts.windows(2).enumerate() {
                let own = &records[pair[0] as usize..pair[1] as usize];
                assert!(own.iter().all(|record| record.0[0] == tile as f32), "piece {piece}, tile {tile}");
            }
        }
    }
}
