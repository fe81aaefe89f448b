// The tiles that a splat touches. For each row of tiles, a closed form gives the extent of the ellipse of the splat
// (alpha of at least 1/255) between the first and the last pixel centres of the row. The pass that counts tiles and the
// pass that emits pairs both use this, so that they find the same tiles.
// Needs: types; the binding `view`.

// Widens the range of pixels on each side, px, so that rounding cannot lose a pixel on the threshold.
const SLACK_PX: f32 = 0.01;

// The first pixel whose centre is in [low - SLACK_PX, high + SLACK_PX], and the pixel after the last such pixel. Both
// are clipped to 0..=size. If there is no such pixel, the second number is not larger than the first.
fn pixels_between(low: f32, high: f32, size: u32) -> vec2<i32> {
    let first = ceil(clamp(low - 0.5 - SLACK_PX, -1.0, f32(size)));
    let last = floor(clamp(high - 0.5 + SLACK_PX, -1.0, f32(size) - 1.0));
    return vec2(max(i32(first), 0), i32(last) + 1);
}

// The first row of tiles that the splat touches, and the row after the last.
fn tile_rows(splat: Projected) -> vec2<i32> {
    let mean = splat.mean_px.y;
    let rows = pixels_between(mean - splat.extent_px.y, mean + splat.extent_px.y, view.size_px.y);
    return tiles_of(rows);
}

// The first tile that the splat touches in a row of tiles, and the tile after the last.
fn tile_span(splat: Projected, tile_y: i32) -> vec2<i32> {
    let mean = splat.mean_px;
    let extent = splat.extent_px;
    let rows = pixels_between(mean.y - extent.y, mean.y + extent.y, view.size_px.y);
    let low = f32(max(tile_y * i32(TILE), rows.x)) + 0.5 - mean.y;
    let high = f32(min((tile_y + 1) * i32(TILE), rows.y) - 1) + 0.5 - mean.y;
    // At the height dy, measured from the mean, the ellipse spans center * dy ± half * sqrt(1 - (dy / extent.y)²). It
    // extends furthest to the right at dy = rightmost, and furthest to the left at dy = -rightmost. The pixels of this
    // row of tiles have dy in low..=high.
    let center = -0.5 * splat.falloff.y / splat.falloff.x;
    let half = sqrt(splat.falloff_max / splat.falloff.x);
    let rightmost = -0.5 * splat.falloff.y / splat.falloff.z * extent.x;
    let at_right = min(max(rightmost, low), high);
    let at_left = min(max(-rightmost, low), high);
    let reach = half * sqrt(max(1.0 - vec2(at_left * at_left, at_right * at_right) / (extent.y * extent.y), vec2(0.0)));
    let left = mean.x + center * at_left - reach.x;
    let right = mean.x + center * at_right + reach.y;
    return tiles_of(pixels_between(left, right, view.size_px.x));
}

// The tiles that a range of pixels covers; an empty range of pixels gives an empty range of tiles.
fn tiles_of(pixels: vec2<i32>) -> vec2<i32> {
    if (pixels.x >= pixels.y) {
        return vec2(0, 0);
    }
    return vec2(pixels.x / i32(TILE), (pixels.y - 1) / i32(TILE) + 1);
}
