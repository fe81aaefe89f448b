// Finds the first pair of each tile in the sorted order, and the end of its pairs. The ranges are zero before the pass;
// those of tiles without pairs remain zero.
// Parts: types.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(GROUP)
fn tile_ranges(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    let count = counters[PAIRS];
    if (i >= count) {
        return;
    }
    let tile = keys[i];
    if (tile >= view.tiles.x * view.tiles.y) {
        return;
    }
    if (i == 0u || keys[max(i, 1u) - 1u] != tile) {
        ranges[tile].x = i;
    }
    if (i + 1u == count || keys[min(i + 1u, count - 1u)] != tile) {
        ranges[tile].y = i + 1u;
    }
}
