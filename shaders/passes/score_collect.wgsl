// Adds the records of a splat's pairs to its scores, in the order of their slots.
// Parts: types.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> slots: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> projected: array<Projected>;
@group(0) @binding(3) var<storage, read> records: array<vec4<f32>>;
// Rows: Σ (α T)² with alpha α and transmittance T, number of pixels hit, number of views that observed the splat.
@group(0) @binding(4) var<storage, read_write> scores: array<f32>;

@compute @workgroup_size(GROUP)
fn score_collect(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    if (i >= view.splats || !(projected[i].falloff_max > 0.0)) {
        return;
    }
    var total = vec4(0.0);
    for (var slot = slots[i].x; slot < slots[i].x + slots[i].y; slot++) {
        total += records[RECORD_VECTORS * slot];
    }
    scores[SQUARED_WEIGHT * view.splat_stride + i] += total.x;
    scores[HITS * view.splat_stride + i] += total.y;
    scores[OBSERVED * view.splat_stride + i] += select(0.0, 1.0, total.z > 0.0);
}
