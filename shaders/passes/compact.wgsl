// Lists the ids of the visible splats with their depths, ascending by id.
// Parts: types.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> depth_keys: array<u32>;
// For each splat, the number of visible splats before it.
@group(0) @binding(2) var<storage, read> places: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> ids: array<u32>;

@compute @workgroup_size(GROUP)
fn compact(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    if (i >= view.splats || depth_keys[i] == NOT_SEEN) {
        return;
    }
    keys[places[i]] = depth_keys[i];
    ids[places[i]] = i;
}
