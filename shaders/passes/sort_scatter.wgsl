// Moves keys and values to their places in the order of one digit. Keys with equal digits keep their order. Each
// workgroup first sorts the keys of its block by the low half of the digit, then by the high half, in its own memory.
// Parts: types, group_scan.

@group(0) @binding(0) var<uniform> step: SortStep;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
// Running sums of the digit counts within each block of counts, and for each block the sum of all blocks before it.
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> block_sums: array<u32>;
@group(0) @binding(4) var<storage, read> keys: array<u32>;
@group(0) @binding(5) var<storage, read> values: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_values: array<u32>;

// Bits of half a digit, and half the number of its values.
const HALF_BITS: u32 = 4u;
const ROWS: u32 = 8u;

// The keys of the block in their order so far: the digit in the lowest 8 bits, above it the place where the key came
// from.
var<workgroup> ordered: array<u32, BLOCK>;
// Row r has an entry for each lane: in its lowest 16 bits the number of the lane's keys whose half digit is r, in its
// highest those whose half digit is r + ROWS. After the scan: the number of keys before them.
var<workgroup> before: array<u32, ROWS * GROUP>;
// For each digit that the block has, its first place in the block, then the distance from there to its place among all
// keys.
var<workgroup> places: array<u32, DIGITS>;

@compute @workgroup_size(GROUP)
fn sort_scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let first = group_index(group) * BLOCK;
    let count = counters[step.counter];
    if (first >= count) {
        return;
    }
    // Each lane takes four consecutive keys, so that the order of the lanes is the order of the keys. Places beyond the
    // last key get the largest digit, and so stay behind all keys.
    var own: vec4<u32>;
    for (var k = 0u; k < 4u; k++) {
        let place = 4u * lane + k;
        var digit = DIGITS - 1u;
        if (first + place < count) {
            digit = (keys[first + place] >> step.shift) & digit;
        }
        own[k] = digit | (place << (2u * HALF_BITS));
    }
    order_by_half(own, 0u, lane);
    for (var k = 0u; k < 4u; k++) {
        own[k] = ordered[4u * lane + k];
    }
    order_by_half(own, HALF_BITS, lane);
    for (var place = lane; place < BLOCK; place += GROUP) {
        let digit = ordered[place] & (DIGITS - 1u);
        if (place == 0u || (ordered[max(place, 1u) - 1u] & (DIGITS - 1u)) != digit) {
            places[digit] = place;
        }
    }
    workgroupBarrier();
    let counted = lane * blocks_of(count) + first / BLOCK;
    places[lane] = counts[counted] + block_sums[counted / BLOCK] - places[lane];
    workgroupBarrier();
    for (var place = lane; place < min(BLOCK, count - first); place += GROUP) {
        let digit = ordered[place] & (DIGITS - 1u);
        let old = first + (ordered[place] >> (2u * HALF_BITS));
        let new_place = places[digit] + place;
        sorted_keys[new_place] = keys[old];
        sorted_values[new_place] = values[old];
    }
}

// Writes the keys of all lanes to `ordered`, in the order of the half digit that begins at bit `shift`. A lane has four
// keys, and equal half digits keep their order.
fn order_by_half(own: vec4<u32>, shift: u32, lane: u32) {
    for (var row = 0u; row < ROWS; row++) {
        before[row * GROUP + lane] = 0u;
    }
    for (var k = 0u; k < 4u; k++) {
        let half = (own[k] >> shift) & (2u * ROWS - 1u);
        before[(half % ROWS) * GROUP + lane] += 1u << (16u * (half / ROWS));
    }
    workgroupBarrier();
    var sum = 0u;
    for (var k = 0u; k < ROWS; k++) {
        sum += before[ROWS * lane + k];
    }
    let sums = sum_before(sum, lane);
    // The larger half digits come after all smaller ones.
    var running = sums.x + (sums.y << 16u);
    for (var k = 0u; k < ROWS; k++) {
        let value = before[ROWS * lane + k];
        before[ROWS * lane + k] = running;
        running += value;
    }
    workgroupBarrier();
    for (var k = 0u; k < 4u; k++) {
        let half = (own[k] >> shift) & (2u * ROWS - 1u);
        let row = (half % ROWS) * GROUP + lane;
        let bit = 16u * (half / ROWS);
        ordered[(before[row] >> bit) & 0xffffu] = own[k];
        before[row] += 1u << bit;
    }
    workgroupBarrier();
}
