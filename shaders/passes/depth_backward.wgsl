// Sums up, for each pixel, the gradients with respect to its depth z. They come from the normal losses of the four
// adjacent pixels, whose normals are computed from depths such as z. Propagates the sum through z = D / -(N . r) to the
// blended plane of the pixel, with ray r, distance D and normal N.
// Parts: types, pixels, surface, surface_gradient.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> image: array<f32>;
@group(0) @binding(2) var<storage, read> depth: array<f32>;
// Gradient of the normal loss of each pixel with respect to the depths of the pixels to its right and left, above and
// below; written by the pass normals.
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

// The gradient that the normal of `pixel` gives to the depth on one of its four sides; 0 outside the picture.
fn given_by(pixel: vec2<u32>, side: u32) -> f32 {
    if (!is_inside(pixel)) {
        return 0.0;
    }
    return given[line_place(pixel)][side];
}
