// Gradients with respect to the blended plane of a pixel.
// Needs: types, pixels; the bindings `view` and `gradient`.

// Adds `v` to the gradient with respect to normal and distance of a pixel.
fn add_to_plane(pixel: vec2<u32>, v: vec4<f32>) {
    let at = pixel_place(view.planes, NORMAL, pixel);
    for (var k = 0u; k < 4u; k++) {
        gradient[at + k * TILE_PIXELS] += v[k];
    }
}

// The gradient with respect to normal N and distance D of a plane, from `v_z`, the gradient with respect to the depth
// z. The depth is z = D / facing with facing = -(N . ray).
fn through_depth(z: f32, ray: vec3<f32>, facing: f32, v_z: f32) -> vec4<f32> {
    let distance = v_z / facing;
    return vec4(distance * z * ray, distance);
}
