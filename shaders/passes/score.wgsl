// Computes what each pair contributes to the picture, and writes it as four numbers to the record of the slot of the
// pair. A workgroup processes a tile; its invocations process one pair each at a time, see crossing.wgsl.
// Parts: types, pixels, tile_list, alpha, crossing.

@group(0) @binding(5) var<storage, read> blended: array<u32>;
// A record has four vectors; this pass writes only the first.
@group(0) @binding(6) var<storage, read_write> records: array<vec4<f32>>;

// A view observes a splat that is blended into one of its pixels while the transmittance is above this (PGSR).
const OBSERVED_TRANSMITTANCE: f32 = 0.5;

// Transmittance of each pixel of the tile; 0 if the pixel is full or outside the picture.
var<workgroup> pixels: array<f32, TILE_PIXELS>;

@compute @workgroup_size(PAIRS_AT_ONCE)
fn score(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = group_index(group);
    if (tile >= tiles()) {
        return;
    }
    let origin = corner_of(tile);
    let range = ranges[tile];
    let pairs = blended[tile];
    for (var at = range.x + pairs + lane; at < range.y; at += PAIRS_AT_ONCE) {
        records[RECORD_VECTORS * sorted_slots[at]] = vec4(0.0);
    }
    for (var pixel = lane; pixel < TILE_PIXELS; pixel += PAIRS_AT_ONCE) {
        pixels[pixel] = select(0.0, 1.0, all(origin + vec2(pixel % TILE, pixel / TILE) < view.size_px));
    }
    workgroupBarrier();
    let steps = crossing_steps(pairs);
    var splat: Projected;
    var sums = vec4(0.0);
    for (var step = 0u; step < steps; step++) {
        let here = crossing(step, lane, pairs);
        if (here.is_under_way) {
            if (here.chunk == 0u) {
                splat = splat_at(range.x + here.pair);
                sums = vec4(0.0);
            }
            add_contribution(origin, here.chunk, splat, &sums);
            if (here.is_last) {
                records[RECORD_VECTORS * sorted_slots[range.x + here.pair]] = sums;
            }
        }
        workgroupBarrier();
    }
}

// Adds the contribution of a splat to a chunk of pixels: Σ (α T)² with alpha α and transmittance T, the number of
// pixels that it is blended into, and how many of these had a transmittance above OBSERVED_TRANSMITTANCE.
fn add_contribution(origin: vec2<u32>, chunk: u32, splat: Projected, sums: ptr<function, vec4<f32>>) {
    for (var pixel = chunk * CHUNK; pixel < (chunk + 1u) * CHUNK; pixel++) {
        let before = pixels[pixel];
        let d = splat.mean_px - (vec2<f32>(origin + vec2(pixel % TILE, pixel / TILE)) + 0.5);
        let raw = raw_alpha(splat, d);
        if (before == 0.0 || !(raw >= ALPHA_MIN)) {
            continue;
        }
        let alpha = min(raw, ALPHA_MAX);
        let after = before - alpha * before;
        pixels[pixel] = select(after, 0.0, after < TRANSMITTANCE_MIN);
        if (after >= TRANSMITTANCE_MIN) {
            let weight = alpha * before;
            *sums += vec4(weight * weight, 1.0, select(0.0, 1.0, before > OBSERVED_TRANSMITTANCE), 0.0);
        }
    }
}
