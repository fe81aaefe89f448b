// Lists the number of tiles of each visible splat, nearest splat first, as input of the next scan.
// Parts: types.

@group(0) @binding(0) var<storage, read> counters: array<u32>;
@group(0) @binding(1) var<storage, read> ids: array<u32>;
@group(0) @binding(2) var<storage, read> slots: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> places: array<u32>;

@compute @workgroup_size(GROUP)
fn order_counts(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let k = group_index(group) * GROUP + lane;
    if (k < counters[VISIBLE]) {
        places[k] = slots[ids[k]].y;
    }
}
