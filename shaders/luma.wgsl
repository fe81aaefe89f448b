// Luma of a photograph, Rec. 601 weights, 0..1. Beyond the picture it is that of whatever the buffer holds.

@group(0) @binding(0) var<uniform> settings: LossSettings;
@group(0) @binding(1) var<storage, read> photograph: array<u32>;
@group(0) @binding(2) var<storage, read_write> luma_plane: array<f32>;

@compute @workgroup_size(GROUP)
fn luma(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = group_index(group, groups) * GROUP + lane;
    if (i >= arrayLength(&luma_plane)) {
        return;
    }
    luma_plane[i] = 0.299 * value(3u * i) + 0.587 * value(3u * i + 1u) + 0.114 * value(3u * i + 2u);
}

fn value(at: u32) -> f32 {
    if (settings.is_floats == 1u) {
        return bitcast<f32>(photograph[at]);
    }
    return f32((photograph[at / 4u] >> (8u * (at % 4u))) & 255u) / 255.0;
}
