// What the passes of the surface losses share: rays, planes and thresholds.
// Needs: types, pixels; the bindings `view` and `image`.

// A ray that meets its plane at an angle of less than about 0.6° gives no usable depth. This is about the sine of the
// angle.
const GRAZING: f32 = 0.01;
// Below this alpha a pixel shows no surface.
const SURFACE_ALPHA: f32 = 0.5;

// Distance, px, between a pixel and the four pixels whose depths give its normal.
const NORMAL_REACH: u32 = 1u;

// The ray through the centre of a pixel, in the camera frame, scaled to z = 1.
fn ray_of(pixel: vec2<f32>) -> vec3<f32> {
    return vec3((pixel + 0.5 - view.center_px) / view.focal_px, 1.0);
}

// The blended plane of a pixel: the normal in the first three components, the plane distance in the fourth.
fn plane_at(pixel: vec2<u32>) -> vec4<f32> {
    let at = pixel_place(view.planes, NORMAL, pixel);
    return vec4(image[at], image[at + TILE_PIXELS], image[at + 2u * TILE_PIXELS], image[at + 3u * TILE_PIXELS]);
}

fn alpha_at(pixel: vec2<u32>) -> f32 {
    return 1.0 - image[pixel_place(view.planes, TRANSMITTANCE, pixel)];
}
