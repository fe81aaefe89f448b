// Moves keys and values to their places in the order of one digit. Keys with equal digits keep their order.
// Parts: types.

@group(0) @binding(0) var<uniform> step: SortStep;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
// Running sums of the digit counts within each block of counts, and for each block the sum of all blocks before it.
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> block_sums: array<u32>;
@group(0) @binding(4) var<storage, read> keys: array<u32>;
@group(0) @binding(5) var<storage, read> values: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_values: array<u32>;

// For each digit and lane, the number of keys with this digit in the lanes before. An entry holds the counts of two
// digits, 16 bits each. Each pair of digits has one row with an entry for each lane.
var<workgroup> before: array<u32, DIGITS / 2u * GROUP>;
var<workgroup> sums: array<u32, GROUP>;

@compute @workgroup_size(GROUP)
fn sort_scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = group_index(group);
    let count = counters[step.counter];
    if (block * BLOCK >= count) {
        return;
    }
    for (var pair = 0u; pair < DIGITS / 2u; pair++) {
        before[pair * GROUP + lane] = 0u;
    }
    // Each lane takes four consecutive keys, so that the order of the lanes is the order of the keys.
    let first = block * BLOCK + 4u * lane;
    for (var at = first; at < min(first + 4u, count); at++) {
        let digit = (keys[at] >> step.shift) & (DIGITS - 1u);
        before[(digit / 2u) * GROUP + lane] += 1u << (16u * (digit & 1u));
    }
    workgroupBarrier();
    sum_rows(lane);
    let blocks = blocks_of(count);
    for (var at = first; at < min(first + 4u, count); at++) {
        let key = keys[at];
        let digit = (key >> step.shift) & (DIGITS - 1u);
        let half = 16u * (digit & 1u);
        let row = (digit / 2u) * GROUP + lane;
        let rank = (before[row] >> half) & 0xffffu;
        before[row] += 1u << half;
        let counted = digit * blocks + block;
        let place = counts[counted] + block_sums[counted / BLOCK] + rank;
        sorted_keys[place] = key;
        sorted_values[place] = values[at];
    }
}

// Replaces each number in a row of `before` by the sum of the numbers before it in the row. 32 lanes process a row, 8
// numbers each.
fn sum_rows(lane: u32) {
    let first = 8u * lane;
    var own = 0u;
    for (var k = 0u; k < 8u; k++) {
        own += before[first + k];
    }
    let place = lane & 31u;
    var sum = own;
    sums[lane] = sum;
    for (var reach = 1u; reach < 32u; reach *= 2u) {
        workgroupBarrier();
        let more = select(0u, sums[max(lane, reach) - reach], place >= reach);
        workgroupBarrier();
        sum += more;
        sums[lane] = sum;
    }
    var running = sum - own;
    for (var k = 0u; k < 8u; k++) {
        let value = before[first + k];
        before[first + k] = running;
        running += value;
    }
    workgroupBarrier();
}
