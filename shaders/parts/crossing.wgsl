// Pairs that cross a tile one behind the other: an invocation is a pair and carries its splat over the tile's pixels, a
// chunk of pixels a step behind the pair before it. So pixels see their splats in order, every sum is made by one
// invocation in the order of the pixels, and nothing is ever added across invocations.
// Needs: types.

// Pairs that a group carries at a time, and pixels of a row that each crosses in a step: what suits the device; the
// sums are the same. A pair must have left a chunk before the one that takes its invocation next comes to it:
// PAIRS_AT_ONCE * CHUNK is at most 256.
override PAIRS_AT_ONCE: u32 = 64u;
override CHUNK: u32 = 4u;

// Where an invocation is in a step: with which of the tile's pairs, at which chunk.
struct Crossing {
    pair: u32,
    chunk: u32,
    is_under_way: bool,
    is_last: bool,
}

// Steps until so many pairs have crossed.
fn crossing_steps(pairs: u32) -> u32 {
    let batches = (pairs + PAIRS_AT_ONCE - 1u) / PAIRS_AT_ONCE;
    // After the last batch has begun, its last pair is PAIRS_AT_ONCE - 1 steps behind its first.
    return select(batches * (TILE_PIXELS / CHUNK) + PAIRS_AT_ONCE - 1u, 0u, batches == 0u);
}

fn crossing(step: u32, lane: u32, pairs: u32) -> Crossing {
    let chunks = TILE_PIXELS / CHUNK;
    let pair = (step - lane) / chunks * PAIRS_AT_ONCE + lane;
    let chunk = (step - lane) % chunks;
    return Crossing(pair, chunk, step >= lane && pair < pairs, chunk == chunks - 1u);
}

// Opacity times falloff, `d` from the pixel to the splat's mean; before thresholds and clamp.
fn raw_alpha(splat: Projected, d: vec2<f32>) -> f32 {
    let falloff = splat.falloff;
    return exp2(splat.log2_opacity - (falloff.x * d.x * d.x + falloff.y * d.x * d.y + falloff.z * d.y * d.y));
}
