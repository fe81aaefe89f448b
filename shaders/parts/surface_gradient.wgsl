// Adds to the gradient of a pixel's plane.
// Needs: types, pixels; the bindings `view` and `gradient`.

fn add_to_plane(pixel: vec2<u32>, v: vec4<f32>) {
    let at = pixel_place(view.planes, NORMAL, pixel);
    for (var k = 0u; k < 4u; k++) {
        gradient[at + k * TILE_PIXELS] += v[k];
    }
}

// z = D / f, f = -(N . r): from ∂L/∂z to the normal and the distance.
fn through_depth(z: f32, ray: vec3<f32>, facing: f32, v_z: f32) -> vec4<f32> {
    let distance = v_z / facing;
    return vec4(distance * z * ray, distance);
}
