// The slope of the photograph at a pixel that is not on its border: the larger central difference of luma.
// Needs: types, pixels; the bindings `view` and `luma_plane`.

fn luma_slope(pixel: vec2<u32>) -> f32 {
    let at = line_place(pixel);
    let across = luma_plane[at + 1u] - luma_plane[at - 1u];
    let down = luma_plane[at - view.size_px.x] - luma_plane[at + view.size_px.x];
    return max(abs(across), abs(down));
}
