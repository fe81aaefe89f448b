// A pipeline of splat-tile pairs: each invocation processes one pair over all pixels of the tile, one chunk of pixels
// behind the pair before it. Pixels thus blend their splats in order, one invocation computes each sum in the order of
// the pixels, and nothing is added across invocations.
// Needs: types.

// Pairs that a workgroup processes at a time, and pixels of a row for each in a step. The best values depend on the
// device; the sums do not. The last pair of a batch must process a chunk before the first pair of the next
// batch does, so PAIRS_AT_ONCE * CHUNK is at most 256.
override PAIRS_AT_ONCE: u32 = 64u;
override CHUNK: u32 = 4u;

// The work of an invocation in a step: one of the tile's pairs, and a chunk of pixels.
struct Crossing {
    pair: u32,
    chunk: u32,
    is_under_way: bool,
    is_last: bool,
}

// Number of steps that a list of `pairs` pairs takes.
fn crossing_steps(pairs: u32) -> u32 {
    let batches = (pairs + PAIRS_AT_ONCE - 1u) / PAIRS_AT_ONCE;
    // The last pair of a batch starts PAIRS_AT_ONCE - 1 steps after its first.
    return select(batches * (TILE_PIXELS / CHUNK) + PAIRS_AT_ONCE - 1u, 0u, batches == 0u);
}

fn crossing(step: u32, lane: u32, pairs: u32) -> Crossing {
    let chunks = TILE_PIXELS / CHUNK;
    let pair = (step - lane) / chunks * PAIRS_AT_ONCE + lane;
    let chunk = (step - lane) % chunks;
    return Crossing(pair, chunk, step >= lane && pair < pairs, chunk == chunks - 1u);
}

// Alpha before thresholds and clamp; `d` points from the pixel to the splat's mean.
fn raw_alpha(splat: Projected, d: vec2<f32>) -> f32 {
    let falloff = splat.falloff;
    return exp2(splat.log2_opacity - (falloff.x * d.x * d.x + falloff.y * d.x * d.y + falloff.z * d.y * d.y));
}
