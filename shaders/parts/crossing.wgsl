// A pipeline over the splat-tile pairs of a tile. An invocation takes one pair through all pixels of the tile, in
// chunks of pixels. In each step, an invocation is one chunk behind the invocation that has the preceding pair. So
// every pixel blends its splats in order. The sums of a pair are computed by one invocation, in the order of the
// pixels, so no sum depends on the division of work.
// Needs: types.

// PAIRS_AT_ONCE is the number of pairs that a workgroup processes at a time: the size of a batch. CHUNK is the number
// of pixels, all in one row, that each invocation processes in a step. The best values depend on the device.
// The last pair of a batch reaches a chunk PAIRS_AT_ONCE - 1 steps after the first pair of the batch does. The first
// pair of the next batch reaches the same chunk 256 / CHUNK steps after the first pair of the batch, and must come
// later than the last pair. So PAIRS_AT_ONCE * CHUNK is at most 256, the number of pixels of a tile.
override PAIRS_AT_ONCE: u32 = 64u;
override CHUNK: u32 = 4u;

// The work of an invocation in a step: a pair and a chunk of pixels, by their numbers in the tile. If `is_under_way` is
// false, the invocation has no work in this step. `is_last` marks the last chunk of the pair.
struct Crossing {
    pair: u32,
    chunk: u32,
    is_under_way: bool,
    is_last: bool,
}

// Number of steps that a list of `pairs` pairs takes.
fn crossing_steps(pairs: u32) -> u32 {
    let batches = (pairs + PAIRS_AT_ONCE - 1u) / PAIRS_AT_ONCE;
    // The last pair of a batch starts PAIRS_AT_ONCE - 1 steps after the first.
    return select(batches * (TILE_PIXELS / CHUNK) + PAIRS_AT_ONCE - 1u, 0u, batches == 0u);
}

// The work of invocation `lane` in a step, for a tile with `pairs` pairs.
fn crossing(step: u32, lane: u32, pairs: u32) -> Crossing {
    let chunks = TILE_PIXELS / CHUNK;
    let pair = (step - lane) / chunks * PAIRS_AT_ONCE + lane;
    let chunk = (step - lane) % chunks;
    return Crossing(pair, chunk, step >= lane && pair < pairs, chunk == chunks - 1u);
}
