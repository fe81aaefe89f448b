// The slope of the photograph at a pixel: the larger of two absolute differences of luma, one between the pixels to its
// right and left, the other between those above and below. The pixel must not be on the border of the picture.
// Needs: types, pixels; the bindings `view` and `luma_plane`.

// Whether the pixel, or one of the four that its slope is computed from, is masked.
fn is_beside_mask(pixel: vec2<u32>) -> bool {
    let at = line_place(pixel);
    let across = min(luma_plane[at + 1u], luma_plane[at - 1u]);
    let down = min(luma_plane[at - view.size_px.x], luma_plane[at + view.size_px.x]);
    return min(luma_plane[at], min(across, down)) < 0.0;
}

fn luma_slope(pixel: vec2<u32>) -> f32 {
    let at = line_place(pixel);
    let across = luma_plane[at + 1u] - luma_plane[at - 1u];
    let down = luma_plane[at - view.size_px.x] - luma_plane[at + view.size_px.x];
    return max(abs(across), abs(down));
}
