// The backward pass of the blend. It repeats the blend from front to back, so the only results of the blend that it
// needs are the final picture and the number of pairs that each tile processed.
//
// A workgroup processes a tile; its invocations process one pair each at a time, see crossing.wgsl. Graphics cards with
// subgroups run rasterize_backward_by_pixel instead.
//
// Let g be the gradient of the loss with respect to the channels of a pixel. The splats behind the current one matter
// only through one number, `rest`: the dot product of what they contribute to the pixel with g. At first `rest` is the
// dot product of the finished pixel with g; then the contribution of each splat is subtracted in turn.
// Parts: types, pixels, tile_list, picture_gradient, alpha, crossing.

@group(0) @binding(5) var<storage, read> blended: array<u32>;
@group(0) @binding(6) var<storage, read> image: array<f32>;
@group(0) @binding(7) var<storage, read> gradient: array<f32>;
// For each slot a record of 16 numbers, summed over pixels; the last is 0. With q = α ∂L/∂α and d = mean - pixel
// centre, they are q, q dx, q dy, q dx², q dx dy, q dy², then ∂L/∂rgb, ∂L/∂normal, ∂L/∂distance, and the absolute
// values of ∂L/∂mean in x and y, times log2(e).
@group(0) @binding(8) var<storage, read_write> records: array<vec4<f32>>;

// For each pixel, its transmittance (0 if the pixel is full or outside the picture) and its `rest`.
var<workgroup> pixels: array<vec2<f32>, TILE_PIXELS>;
// Gradient of the loss with respect to the pixels of the tile: to colours, then to normal and distance.
var<workgroup> v_rgbs: array<vec3<f32>, TILE_PIXELS>;
var<workgroup> v_surfaces: array<vec4<f32>, TILE_PIXELS>;

@compute @workgroup_size(PAIRS_AT_ONCE)
fn rasterize_backward(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = group_index(group);
    if (tile >= tiles()) {
        return;
    }
    let origin = corner_of(tile);
    let range = ranges[tile];
    let pairs = blended[tile];
    // Entries of the list that the blend did not process have gradient zero.
    for (var at = range.x + pairs + lane; at < range.y; at += PAIRS_AT_ONCE) {
        write_record(sorted_slots[at], Sums());
    }
    for (var pixel = lane; pixel < TILE_PIXELS; pixel += PAIRS_AT_ONCE) {
        v_rgbs[pixel] = v_rgb_of(tile, pixel);
        v_surfaces[pixel] = v_surface_of(tile, pixel);
        let inside = all(origin + vec2(pixel % TILE, pixel / TILE) < view.size_px);
        pixels[pixel] = vec2(select(0.0, 1.0, inside), finished(tile, pixel));
    }
    workgroupBarrier();
    let steps = crossing_steps(pairs);
    var splat: Projected;
    var sums: Sums;
    for (var step = 0u; step < steps; step++) {
        let here = crossing(step, lane, pairs);
        if (here.is_under_way) {
            if (here.chunk == 0u) {
                splat = splat_at(range.x + here.pair);
                sums = Sums();
            }
            carry(origin, here.chunk, splat, &sums);
            if (here.is_last) {
                write_record(sorted_slots[range.x + here.pair], sums);
            }
        }
        workgroupBarrier();
    }
}

// The record of a pair, summed over the pixels of the tile.
struct Sums {
    q: f32,
    q_d: vec2<f32>,
    // q dx², q dx dy, q dy².
    q_dd: vec3<f32>,
    rgb: vec3<f32>,
    // Gradients with respect to normal and distance.
    surface: vec4<f32>,
    absolute: vec2<f32>,
}

fn write_record(slot: u32, s: Sums) {
    records[RECORD_VECTORS * slot] = vec4(s.q, s.q_d, s.q_dd.x);
    records[RECORD_VECTORS * slot + 1u] = vec4(s.q_dd.yz, s.rgb.xy);
    records[RECORD_VECTORS * slot + 2u] = vec4(s.rgb.z, s.surface.xyz);
    records[RECORD_VECTORS * slot + 3u] = vec4(s.surface.w, s.absolute, 0.0);
}

// Adds the contributions of a splat in a chunk of pixels of one row to `sums`, and advances the state of these pixels.
fn carry(origin: vec2<u32>, chunk: u32, splat: Projected, sums: ptr<function, Sums>) {
    let first = chunk * CHUNK;
    let y = f32(origin.y + first / TILE) + 0.5;
    let dy = splat.mean_px.y - y;
    if (abs(dy) > splat.extent_px.y + 0.5) {
        return;
    }
    for (var pixel = first; pixel < first + CHUNK; pixel++) {
        let state = pixels[pixel];
        if (state.x == 0.0) {
            continue;
        }
        let d = vec2(splat.mean_px.x - (f32(origin.x + pixel % TILE) + 0.5), dy);
        let raw = raw_alpha(splat, d);
        if (!(raw >= ALPHA_MIN)) {
            continue;
        }
        let alpha = min(raw, ALPHA_MAX);
        let after = state.x - alpha * state.x;
        if (after < TRANSMITTANCE_MIN) {
            pixels[pixel].x = 0.0;
            continue;
        }
        let weight = alpha * state.x;
        let v_rgb = v_rgbs[pixel];
        var value = dot(v_rgb, splat.rgb);
        (*sums).rgb += weight * v_rgb;
        if (view.planes == PLANES_GEOMETRY) {
            let v_surface = v_surfaces[pixel];
            value += dot(v_surface, vec4(splat.normal, splat.plane_distance));
            (*sums).surface += weight * v_surface;
        }
        let behind = state.y - weight * value;
        pixels[pixel] = vec2(after, behind);
        // q = α ∂L/∂α = α T value - α / (1 - α) rest, with T the transmittance before the splat and `rest` without the
        // splat. It is zero where alpha is clamped.
        if (raw < ALPHA_MAX) {
            let q = weight * value - alpha / (1.0 - alpha) * behind;
            (*sums).q += q;
            (*sums).q_d += q * d;
            (*sums).q_dd += q * vec3(d.x * d.x, d.x * d.y, d.y * d.y);
            let falloff = splat.falloff;
            let slopes = vec2(2.0 * falloff.x * d.x + falloff.y * d.y, falloff.y * d.x + 2.0 * falloff.z * d.y);
            (*sums).absolute += abs(q * slopes);
        }
    }
}
