// The alpha of a splat at a pixel.
// Needs: types.

// Alpha before thresholds and clamp. `d` is the mean of the splat minus the centre of the pixel, px.
fn raw_alpha(splat: Projected, d: vec2<f32>) -> f32 {
    let falloff = splat.falloff;
    return exp2(splat.log2_opacity - (falloff.x * d.x * d.x + falloff.y * d.x * d.y + falloff.z * d.y * d.y));
}
