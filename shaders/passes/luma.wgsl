// Computes the luma of a photograph, 0..1, row by row; below 0 for masked pixels. The buffer `luma_plane` may be longer than the photograph; what
// this pass writes beyond the photograph is never used.
// Parts: types, photograph.

@group(0) @binding(0) var<uniform> settings: LossSettings;
@group(0) @binding(1) var<storage, read> photograph: array<u32>;
@group(0) @binding(2) var<storage, read_write> luma_plane: array<f32>;

// Stands for the luma of a masked pixel. Below all lumas.
const MASKED_LUMA: f32 = -1.0;
// Weights of red, green and blue (Rec. 601).
const LUMA_WEIGHTS = array<f32, 3>(0.299, 0.587, 0.114);

@compute @workgroup_size(GROUP)
fn luma(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    if (i >= arrayLength(&luma_plane)) {
        return;
    }
    let red = photograph_value(3u * i);
    let green = photograph_value(3u * i + 1u);
    let blue = photograph_value(3u * i + 2u);
    let value = LUMA_WEIGHTS[0] * red + LUMA_WEIGHTS[1] * green + LUMA_WEIGHTS[2] * blue;
    luma_plane[i] = select(value, MASKED_LUMA, is_masked(3u * i));
}
