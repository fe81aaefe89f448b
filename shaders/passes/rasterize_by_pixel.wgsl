// The blend, for graphics cards. It yields the same as the pass rasterize, but an invocation processes one pixel: on a
// card (H100) that takes half to two thirds of the time, in a software driver three times as long.
// Parts: types, pixels, tile_list, blocks, alpha, open_tile.

// As in the pass rasterize.
@group(0) @binding(5) var<storage, read_write> blended: array<u32>;
@group(0) @binding(6) var<storage, read_write> image: array<f32>;

// Number of splats that a workgroup reads at a time.
const BATCH: u32 = 128u;

var<workgroup> batch: array<Projected, BATCH>;

@compute @workgroup_size(TILE_PIXELS)
fn rasterize_by_pixel(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = group_index(group);
    if (tile >= tiles()) {
        return;
    }
    let inner = place_in_blocks(lane);
    let pixel = corner_of(tile) + inner;
    let center = vec2<f32>(pixel) + 0.5;
    let range = ranges[tile];

    // Transmittance of the pixel, or 0 if it is full or outside the picture; `left` is that of a full pixel.
    var open = select(0.0, 1.0, is_inside(pixel));
    var left = 0.0;
    var rgb = vec3(0.0);
    // Blended normal and plane distance.
    var surface = vec4(0.0);
    var first = range.x;
    for (; first < range.y; first += BATCH) {
        if (!any_open(open > 0.0, lane)) {
            break;
        }
        let count = min(BATCH, range.y - first);
        if (lane < count) {
            batch[lane] = splat_at(first + lane);
        }
        workgroupBarrier();
        for (var k = 0u; k < count && open > 0.0; k++) {
            let raw = raw_alpha(batch[k], batch[k].mean_px - center);
            // A comparison with NaN is false, so NaN is skipped.
            if (!(raw >= ALPHA_MIN)) {
                continue;
            }
            let alpha = min(raw, ALPHA_MAX);
            let after = open - alpha * open;
            if (after < TRANSMITTANCE_MIN) {
                left = open;
                open = 0.0;
                break;
            }
            let weight = alpha * open;
            open = after;
            rgb += weight * batch[k].rgb;
            if (view.planes == PLANES_GEOMETRY) {
                surface += weight * vec4(batch[k].normal, batch[k].plane_distance);
            }
        }
    }
    if (lane == 0u) {
        blended[tile] = min(first, range.y) - range.x;
    }
    let at = tile * view.planes * TILE_PIXELS + inner.y * TILE + inner.x;
    put(at, 0u, vec4(rgb, left + open));
    if (view.planes == PLANES_GEOMETRY) {
        put(at, NORMAL, surface);
    }
}

// Writes four planes of the pixel whose value in plane 0 is image[at].
fn put(at: u32, plane: u32, values: vec4<f32>) {
    for (var k = 0u; k < 4u; k++) {
        image[at + (plane + k) * TILE_PIXELS] = values[k];
    }
}
