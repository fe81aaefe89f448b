// Adds the gradients of a pixel's depth that the normals of its neighbours wrote, and propagates them through
// z = D / -(N . r) to the pixel's plane.
// Parts: types, pixels, surface, surface_gradient.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> image: array<f32>;
@group(0) @binding(2) var<storage, read> depth: array<f32>;
// From normals.wgsl: gradients of the depths to the right, to the left, above and below.
@group(0) @binding(3) var<storage, read> given: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> gradient: array<f32>;

@compute @workgroup_size(GROUP)
fn depth_backward(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let pixel = pixel_of(group_index(group), lane);
    if (!is_inside(pixel)) {
        return;
    }
    let z = depth[line_place(pixel)];
    if (!(z > 0.0)) {
        return;
    }
    // Left of and above the picture the subtraction wraps around, to coordinates far outside the picture.
    let right = vec2(NORMAL_REACH, 0u);
    let below = vec2(0u, NORMAL_REACH);
    let v_z = given_by(pixel - right, 0u) + given_by(pixel + right, 1u) + given_by(pixel + below, 2u) + given_by(pixel - below, 3u);
    let ray = ray_of(vec2<f32>(pixel));
    add_to_plane(pixel, through_depth(z, ray, -dot(plane_at(pixel).xyz, ray), v_z));
}

fn given_by(pixel: vec2<u32>, side: u32) -> f32 {
    if (!is_inside(pixel)) {
        return 0.0;
    }
    return given[line_place(pixel)][side];
}
