// What each pair gives to the picture: a record of four numbers by slot. Pairs cross the tile one behind the other, as
// in rasterize_backward.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> id_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> blended: array<u32>;
// The first of a slot's four vectors: SCORES.
@group(0) @binding(6) var<storage, read_write> records: array<vec4<f32>>;

// Pairs that a group carries at a time, and pixels of a row that each crosses in a step: what suits the device.
override PAIRS_AT_ONCE: u32 = 64u;
override CHUNK: u32 = 4u;
// A splat is observed where it is hit before this much of the light is gone (PGSR).
const OBSERVED_TRANSMITTANCE: f32 = 0.5;

// Transmittance of each pixel; 0 once it is full.
var<workgroup> pixels: array<f32, TILE_PIXELS>;

@compute @workgroup_size(PAIRS_AT_ONCE)
fn score(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_index(group, groups);
    if (tile >= view.tiles.x * view.tiles.y) {
        return;
    }
    let origin = TILE * vec2(tile % view.tiles.x, tile / view.tiles.x);
    let range = ranges[tile];
    let end = range.x + blended[tile];
    for (var at = end + lane; at < range.y; at += PAIRS_AT_ONCE) {
        records[4u * sorted_slots[at]] = vec4(0.0);
    }
    for (var pixel = lane; pixel < TILE_PIXELS; pixel += PAIRS_AT_ONCE) {
        pixels[pixel] = select(0.0, 1.0, all(origin + vec2(pixel % TILE, pixel / TILE) < view.size_px));
    }
    workgroupBarrier();
    let chunks = TILE_PIXELS / CHUNK;
    let batches = (end - range.x + PAIRS_AT_ONCE - 1u) / PAIRS_AT_ONCE;
    let steps = select(batches * chunks + PAIRS_AT_ONCE - 1u, 0u, batches == 0u);
    var splat: Projected;
    var sums = vec4(0.0);
    for (var step = 0u; step < steps; step++) {
        let chunk = (step - lane) % chunks;
        let at = range.x + (step - lane) / chunks * PAIRS_AT_ONCE + lane;
        if (step >= lane && at < end) {
            if (chunk == 0u) {
                splat = projected[id_of_slot[sorted_slots[at]]];
                sums = vec4(0.0);
            }
            give(origin, chunk, splat, &sums);
            if (chunk == chunks - 1u) {
                records[4u * sorted_slots[at]] = sums;
            }
        }
        workgroupBarrier();
    }
}

// Adds what a splat gives to a chunk of pixels: Σ (α T)², pixels hit, pixels hit while more than half of the light came
// through.
fn give(origin: vec2<u32>, chunk: u32, splat: Projected, sums: ptr<function, vec4<f32>>) {
    for (var pixel = chunk * CHUNK; pixel < (chunk + 1u) * CHUNK; pixel++) {
        let before = pixels[pixel];
        let d = splat.mean_px - (vec2<f32>(origin + vec2(pixel % TILE, pixel / TILE)) + 0.5);
        let falloff = splat.falloff;
        let raw = exp2(splat.log2_opacity - (falloff.x * d.x * d.x + falloff.y * d.x * d.y + falloff.z * d.y * d.y));
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
