// The blend: front to back over each tile's list. A group is a tile, an invocation a pixel.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
// Slots of the pairs, tile by tile, nearest first; and their splats.
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> id_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
// Entries of a tile's list that were looked at before all its pixels were full: all, or whole batches.
@group(0) @binding(5) var<storage, read_write> blended: array<u32>;
@group(0) @binding(6) var<storage, read_write> image: array<f32>;

// Splats that a group reads at a time.
const BATCH: u32 = 128u;

var<workgroup> batch: array<Projected, BATCH>;
var<workgroup> open_pixels: atomic<u32>;
var<workgroup> is_open: u32;

@compute @workgroup_size(GROUP)
fn rasterize(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_index(group, groups);
    if (tile >= view.tiles.x * view.tiles.y) {
        return;
    }
    let pixel = TILE * vec2(tile % view.tiles.x, tile / view.tiles.x) + vec2(lane % TILE, lane / TILE);
    let center = vec2<f32>(pixel) + 0.5;
    let range = ranges[tile];

    // Transmittance while the pixel is open; 0 once it is full, and then `left` is where it was left.
    var open = select(0.0, 1.0, all(pixel < view.size_px));
    var left = 0.0;
    var rgb = vec3(0.0);
    var surface = vec4(0.0);
    var first = range.x;
    for (; first < range.y; first += BATCH) {
        if (!any_open(open > 0.0, lane)) {
            break;
        }
        let count = min(BATCH, range.y - first);
        if (lane < count) {
            batch[lane] = projected[id_of_slot[sorted_slots[first + lane]]];
        }
        workgroupBarrier();
        for (var k = 0u; k < count; k++) {
            if (open == 0.0) {
                break;
            }
            let d = batch[k].mean_px - center;
            let falloff = batch[k].falloff;
            let log2_alpha = batch[k].log2_opacity - (falloff.x * d.x * d.x + falloff.y * d.x * d.y + falloff.z * d.y * d.y);
            let raw = exp2(log2_alpha);
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
            rgb += weight * batch[k].rgb;
            surface += weight * vec4(batch[k].normal, batch[k].plane_distance);
            open = after;
        }
    }
    if (lane == 0u) {
        blended[tile] = min(first, range.y) - range.x;
    }
    put(tile, 0u, lane, rgb.x);
    put(tile, 1u, lane, rgb.y);
    put(tile, 2u, lane, rgb.z);
    put(tile, TRANSMITTANCE, lane, left + open);
    if (view.planes == PLANES_GEOMETRY) {
        put(tile, NORMAL, lane, surface.x);
        put(tile, NORMAL + 1u, lane, surface.y);
        put(tile, NORMAL + 2u, lane, surface.z);
        put(tile, DISTANCE, lane, surface.w);
    }
}

// Whether a pixel of the tile is open; also a barrier before the next batch.
fn any_open(open: bool, lane: u32) -> bool {
    if (lane == 0u) {
        atomicStore(&open_pixels, 0u);
    }
    workgroupBarrier();
    if (open) {
        atomicOr(&open_pixels, 1u);
    }
    workgroupBarrier();
    if (lane == 0u) {
        is_open = atomicLoad(&open_pixels);
    }
    return workgroupUniformLoad(&is_open) == 1u;
}

fn put(tile: u32, plane: u32, pixel: u32, value: f32) {
    image[(tile * view.planes + plane) * TILE_PIXELS + pixel] = value;
}
