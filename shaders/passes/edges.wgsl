// Finds the smallest and the largest slope of the photograph. Non-negative floats have the same order as their bits, so
// atomics on integers find both. The result does not depend on the order of execution.
// Parts: types, pixels, luma_slope.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> luma_plane: array<f32>;
// Bits of the smallest and the largest slope. Before the pass they are those of infinity and of 0.
@group(0) @binding(2) var<storage, read_write> slopes: array<atomic<u32>, 2>;

var<workgroup> least: atomic<u32>;
var<workgroup> most: atomic<u32>;

@compute @workgroup_size(GROUP)
fn edges(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    if (lane == 0u) {
        atomicStore(&least, 0x7f800000u);
        atomicStore(&most, 0u);
    }
    workgroupBarrier();
    let pixel = pixel_of(group_index(group), lane);
    if (all(pixel > vec2(0u)) && all(pixel + 1u < view.size_px) && !is_beside_mask(pixel)) {
        let bits = bitcast<u32>(luma_slope(pixel));
        atomicMin(&least, bits);
        atomicMax(&most, bits);
    }
    workgroupBarrier();
    if (lane == 0u) {
        atomicMin(&slopes[0], atomicLoad(&least));
        atomicMax(&slopes[1], atomicLoad(&most));
    }
}
