// The blend: blends the splats in the list of each tile from front to back. A workgroup processes a tile, an invocation
// four pixels of a row, so that each splat is read once for four pixels. Graphics cards run rasterize_by_pixel instead.
// Parts: types, pixels, tile_list, open_tile.

// Number of entries in the list of each tile that were processed. A tile is finished after the batch in which its last
// pixel becomes full, so the number is the length of the list or a multiple of BATCH.
@group(0) @binding(5) var<storage, read_write> blended: array<u32>;
@group(0) @binding(6) var<storage, read_write> image: array<f32>;

// Number of invocations of a workgroup, and number of pixels of each invocation.
const LANES: u32 = 64u;
const PIXELS: u32 = 4u;
// Number of splats that a workgroup reads at a time.
const BATCH: u32 = 128u;

var<workgroup> batch: array<Projected, BATCH>;

@compute @workgroup_size(LANES)
fn rasterize(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = group_index(group);
    if (tile >= tiles()) {
        return;
    }
    let first_pixel = PIXELS * lane;
    let corner = corner_of(tile) + vec2(first_pixel % TILE, first_pixel / TILE);
    let columns = vec4(corner.x) + vec4(0u, 1u, 2u, 3u);
    let x = vec4<f32>(columns) + 0.5;
    let y = f32(corner.y) + 0.5;
    let range = ranges[tile];

    // `open` is the transmittance of each pixel, or 0 if the pixel is full or outside the picture. `left` is the final
    // transmittance of a full pixel, and 0 for all others.
    let inside = (columns < vec4(view.size_px.x)) & vec4(corner.y < view.size_px.y);
    var open = select(vec4(0.0), vec4(1.0), inside);
    var left = vec4(0.0);
    // Blended colour, normal and plane distance of the four pixels.
    var red = vec4(0.0);
    var green = vec4(0.0);
    var blue = vec4(0.0);
    var surface = mat4x4<f32>();
    var first = range.x;
    for (; first < range.y; first += BATCH) {
        if (!any_open(any(open > vec4(0.0)), lane)) {
            break;
        }
        let count = min(BATCH, range.y - first);
        for (var k = lane; k < count; k += LANES) {
            batch[k] = splat_at(first + k);
        }
        workgroupBarrier();
        for (var k = 0u; k < count; k++) {
            if (all(open == vec4(0.0))) {
                break;
            }
            let dx = batch[k].mean_px.x - x;
            let dy = batch[k].mean_px.y - y;
            let falloff = batch[k].falloff;
            let raw = exp2(batch[k].log2_opacity - (falloff.x * dx * dx + falloff.y * dx * dy + falloff.z * dy * dy));
            // A comparison with NaN is false, so NaN is skipped.
            let is_hit = (raw >= vec4(ALPHA_MIN)) & (open > vec4(0.0));
            if (!any(is_hit)) {
                continue;
            }
            let alpha = min(raw, vec4(ALPHA_MAX));
            let after = open - alpha * open;
            let fills = is_hit & (after < vec4(TRANSMITTANCE_MIN));
            let weight = select(vec4(0.0), alpha * open, is_hit & !fills);
            left = select(left, open, fills);
            open = select(select(open, after, is_hit), vec4(0.0), fills);
            let rgb = batch[k].rgb;
            red += weight * rgb.x;
            green += weight * rgb.y;
            blue += weight * rgb.z;
            if (view.planes == PLANES_GEOMETRY) {
                let normal = batch[k].normal;
                surface[0] += weight * normal.x;
                surface[1] += weight * normal.y;
                surface[2] += weight * normal.z;
                surface[3] += weight * batch[k].plane_distance;
            }
        }
    }
    if (lane == 0u) {
        blended[tile] = min(first, range.y) - range.x;
    }
    put(tile, 0u, first_pixel, red);
    put(tile, 1u, first_pixel, green);
    put(tile, 2u, first_pixel, blue);
    put(tile, TRANSMITTANCE, first_pixel, left + open);
    if (view.planes == PLANES_GEOMETRY) {
        for (var k = 0u; k < 4u; k++) {
            put(tile, NORMAL + k, first_pixel, surface[k]);
        }
    }
}

fn put(tile: u32, plane: u32, pixel: u32, values: vec4<f32>) {
    let at = (tile * view.planes + plane) * TILE_PIXELS + pixel;
    for (var k = 0u; k < PIXELS; k++) {
        image[at + k] = values[k];
    }
}
