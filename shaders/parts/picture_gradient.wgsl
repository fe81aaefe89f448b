// The gradient of the picture in the backward pass of the blend.
// Needs: types, tile_list; the bindings `image` and `gradient`.

fn place(tile: u32, plane: u32, pixel: u32) -> u32 {
    return (tile * view.planes + plane) * TILE_PIXELS + pixel;
}

// The gradients of the loss with respect to a pixel's colour, and to its normal and distance.
fn v_rgb_of(tile: u32, pixel: u32) -> vec3<f32> {
    return vec3(
        gradient[place(tile, 0u, pixel)], gradient[place(tile, 1u, pixel)], gradient[place(tile, 2u, pixel)],
    );
}

fn v_surface_of(tile: u32, pixel: u32) -> vec4<f32> {
    if (view.planes != PLANES_GEOMETRY) {
        return vec4(0.0);
    }
    return vec4(
        gradient[place(tile, NORMAL, pixel)],
        gradient[place(tile, NORMAL + 1u, pixel)],
        gradient[place(tile, NORMAL + 2u, pixel)],
        gradient[place(tile, DISTANCE, pixel)],
    );
}

// Dot product of a finished pixel with the gradient with respect to it: the first value of `rest`.
fn finished(tile: u32, pixel: u32) -> f32 {
    var rest = 0.0;
    for (var plane = 0u; plane < view.planes; plane++) {
        rest += image[place(tile, plane, pixel)] * gradient[place(tile, plane, pixel)];
    }
    return rest;
}
