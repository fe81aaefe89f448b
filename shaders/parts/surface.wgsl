// The surface losses: rays, planes and thresholds.
// Needs: types, pixels; the bindings `view` and `image`.

// A ray that meets its plane at less than about 0.6° has no usable depth.
const GRAZING: f32 = 0.01;
// Below this alpha a pixel shows no surface.
const SURFACE_ALPHA: f32 = 0.5;

// Distance of the pixels whose depths give a pixel's normal, px.
const NORMAL_REACH: u32 = 1u;

// The ray through a pixel's centre, scaled to z = 1.
fn ray_of(pixel: vec2<f32>) -> vec3<f32> {
    return vec3((pixel + 0.5 - view.center_px) / view.focal_px, 1.0);
}

// The blended normal of a pixel, and its plane distance as the fourth component.
fn plane_at(pixel: vec2<u32>) -> vec4<f32> {
    let at = pixel_place(view.planes, NORMAL, pixel);
    return vec4(image[at], image[at + TILE_PIXELS], image[at + 2u * TILE_PIXELS], image[at + 3u * TILE_PIXELS]);
}

fn alpha_at(pixel: vec2<u32>) -> f32 {
    return 1.0 - image[pixel_place(view.planes, TRANSMITTANCE, pixel)];
}
