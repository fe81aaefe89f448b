// The backward pass of the blend, for graphics cards with subgroups. It computes the same sums as the pass
// rasterize_backward, where they are explained, but divides the work differently: an invocation processes one pixel,
// and a subgroup skips the splats that reach none of its pixels. On a card (H100) it takes a quarter of the time.
//
// A sum over the pixels of a tile is made in a fixed order: first within each subgroup, then over the subgroups.
// Parts: types, pixels, tile_list, picture_gradient, blocks, alpha.

@group(0) @binding(5) var<storage, read> blended: array<u32>;
@group(0) @binding(6) var<storage, read> image: array<f32>;
@group(0) @binding(7) var<storage, read> gradient: array<f32>;
// The records of rasterize_backward, number by number.
@group(0) @binding(8) var<storage, read_write> records: array<f32>;

// Number of invocations of each subgroup: 8, 16, 32 or 64.
override SUBGROUP: u32 = 32u;
// Number of numbers of a record.
const RECORD_LEN: u32 = 16u;

// The pairs that the workgroup processes at a time, up to 32.
var<workgroup> batch: array<Projected, 32>;
// For each subgroup, and for each pair of the batch, the record of the pair, summed over the pixels of the subgroup.
// There are 256 / SUBGROUP subgroups and SUBGROUP / 2 pairs.
var<workgroup> partial_sums: array<f32, 2048>;
// For each pair of the batch, a bit for each subgroup that it reaches.
var<workgroup> reached: array<atomic<u32>, 32>;

// What a pixel knows while its splats are processed from front to back.
struct Pixel {
    center: vec2<f32>,
    // Transmittance; 0 if the pixel is full or outside the picture.
    open: f32,
    // Dot product of what the splats behind contribute with the gradient.
    rest: f32,
    v_rgb: vec3<f32>,
    v_surface: vec4<f32>,
}

@compute @workgroup_size(TILE_PIXELS)
fn rasterize_backward_by_pixel(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let tile = group_index(group);
    if (tile >= tiles()) {
        return;
    }
    let range = ranges[tile];
    let pairs = blended[tile];
    // Entries of the list that the blend did not process have gradient zero.
    for (var k = pairs * RECORD_LEN + index; k < (range.y - range.x) * RECORD_LEN; k += TILE_PIXELS) {
        records[sorted_slots[range.x + k / RECORD_LEN] * RECORD_LEN + k % RECORD_LEN] = 0.0;
    }
    var pixel = pixel_at(tile, place_in_blocks(subgroup * SUBGROUP + lane));
    for (var first = 0u; first < pairs; first += SUBGROUP / 2u) {
        let count = min(SUBGROUP / 2u, pairs - first);
        if (index < count) {
            batch[index] = splat_at(range.x + first + index);
            atomicStore(&reached[index], 0u);
        }
        workgroupBarrier();
        for (var k = 0u; k < count; k++) {
            let d = batch[k].mean_px - pixel.center;
            let raw = raw_alpha(batch[k], d);
            let is_hit = pixel.open > 0.0 && raw >= ALPHA_MIN;
            if (!subgroupAny(is_hit)) {
                continue;
            }
            let sums = eighths(contribution(batch[k], d, raw, is_hit, &pixel), lane);
            add_up(sums, (subgroup * SUBGROUP / 2u + k) * RECORD_LEN, lane);
            if (lane == 0u) {
                atomicOr(&reached[k], 1u << subgroup);
            }
        }
        workgroupBarrier();
        for (var k = index; k < count * RECORD_LEN; k += TILE_PIXELS) {
            records[sorted_slots[range.x + first + k / RECORD_LEN] * RECORD_LEN + k % RECORD_LEN] = whole_sum(k);
        }
        workgroupBarrier();
    }
}

fn pixel_at(tile: u32, inner: vec2<u32>) -> Pixel {
    let at = corner_of(tile) + inner;
    let number = inner.y * TILE + inner.x;
    let open = select(0.0, 1.0, is_inside(at));
    return Pixel(
        vec2<f32>(at) + 0.5, open, finished(tile, number), v_rgb_of(tile, number), v_surface_of(tile, number),
    );
}

// The record of a splat at one pixel, and the state of the pixel behind the splat. Zero unless the splat is blended.
fn contribution(splat: Projected, d: vec2<f32>, raw: f32, is_hit: bool, pixel: ptr<function, Pixel>) -> mat4x4<f32> {
    let before = (*pixel).open;
    let alpha = min(raw, ALPHA_MAX);
    let after = before - alpha * before;
    let is_blended = is_hit && after >= TRANSMITTANCE_MIN;
    let weight = select(0.0, alpha * before, is_blended);
    let v_rgb = (*pixel).v_rgb;
    let v_surface = (*pixel).v_surface;
    let value = dot(v_rgb, splat.rgb) + dot(v_surface, vec4(splat.normal, splat.plane_distance));
    let behind = (*pixel).rest - weight * value;
    (*pixel).rest = behind;
    (*pixel).open = select(before, select(0.0, after, is_blended), is_hit);
    // As in rasterize_backward: zero where alpha is clamped.
    let q = select(0.0, weight * value - alpha / (1.0 - alpha) * behind, is_blended && raw < ALPHA_MAX);
    let falloff = splat.falloff;
    let slopes = vec2(2.0 * falloff.x * d.x + falloff.y * d.y, falloff.y * d.x + 2.0 * falloff.z * d.y);
    let rgb = weight * v_rgb;
    let surface = weight * v_surface;
    return mat4x4(
        vec4(q, q * d, q * d.x * d.x),
        vec4(q * d.x * d.y, q * d.y * d.y, rgb.xy),
        vec4(rgb.z, surface.xyz),
        vec4(surface.w, abs(q * slopes), 0.0),
    );
}

// Sums the 16 numbers over groups of 8 invocations. In each of three steps an invocation gives half of its numbers to a
// partner and adds the partner's other half to its own, so that it ends with the sums of two of the numbers: those from
// `first_number` on.
fn eighths(v: mat4x4<f32>, lane: u32) -> vec2<f32> {
    let is_second = (lane & 1u) != 0u;
    let a = select(v[0], v[2], is_second) + subgroupShuffleXor(select(v[2], v[0], is_second), 1u);
    let b = select(v[1], v[3], is_second) + subgroupShuffleXor(select(v[3], v[1], is_second), 1u);
    let is_third = (lane & 2u) != 0u;
    let c = select(a, b, is_third) + subgroupShuffleXor(select(b, a, is_third), 2u);
    let is_fifth = (lane & 4u) != 0u;
    return select(c.xy, c.zw, is_fifth) + subgroupShuffleXor(select(c.zw, c.xy, is_fifth), 4u);
}

fn first_number(lane: u32) -> u32 {
    return 8u * (lane & 1u) + 2u * (lane & 2u) + (lane & 4u) / 2u;
}

// Adds the sums over groups of 8 invocations up to sums over the subgroup, and writes them from partial_sums[base] on.
fn add_up(sums: vec2<f32>, base: u32, lane: u32) {
    let at = base + first_number(lane);
    if (SUBGROUP == 8u) {
        partial_sums[at] = sums.x;
        partial_sums[at + 1u] = sums.y;
        return;
    }
    let is_ninth = (lane & 8u) != 0u;
    var sum = select(sums.x, sums.y, is_ninth) + subgroupShuffleXor(select(sums.y, sums.x, is_ninth), 8u);
    if (SUBGROUP >= 32u) {
        sum += subgroupShuffleXor(sum, 16u);
    }
    if (SUBGROUP >= 64u) {
        sum += subgroupShuffleXor(sum, 32u);
    }
    if (lane < 16u) {
        partial_sums[at + (lane & 8u) / 8u] = sum;
    }
}

// The sum over the tile of a number of a record. Numbers are counted through the records of the batch.
fn whole_sum(number: u32) -> f32 {
    let bits = atomicLoad(&reached[number / RECORD_LEN]);
    var sum = 0.0;
    for (var subgroup = 0u; subgroup < TILE_PIXELS / SUBGROUP; subgroup++) {
        if ((bits >> subgroup & 1u) != 0u) {
            sum += partial_sums[subgroup * SUBGROUP / 2u * RECORD_LEN + number];
        }
    }
    return sum;
}
