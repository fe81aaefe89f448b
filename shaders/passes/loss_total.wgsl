// Sums up the loss sums of all tiles and channels, in a fixed order. Runs as one workgroup.
// Parts: types.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> sums: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> totals: array<vec4<f32>>;

var<workgroup> lanes: array<vec4<f32>, 2u * GROUP>;

@compute @workgroup_size(GROUP)
fn loss_total(@builtin(local_invocation_index) lane: u32) {
    let jobs = 3u * view.tiles.x * view.tiles.y;
    var first = vec4(0.0);
    var second = vec4(0.0);
    for (var job = lane; job < jobs; job += GROUP) {
        first += sums[LOSS_VECTORS * job];
        second += sums[LOSS_VECTORS * job + 1u];
    }
    lanes[2u * lane] = first;
    lanes[2u * lane + 1u] = second;
    for (var reach = GROUP / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if (lane < reach) {
            lanes[2u * lane] += lanes[2u * (lane + reach)];
            lanes[2u * lane + 1u] += lanes[2u * (lane + reach) + 1u];
        }
    }
    workgroupBarrier();
    if (lane < 2u) {
        totals[lane] = lanes[lane];
    }
}
