// Replaces each number by the sum of the numbers before it in its block, and writes the sum of each block.
// Parts: types, group_scan.

@group(0) @binding(0) var<uniform> step: ScanStep;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> block_sums: array<u32>;

@compute @workgroup_size(GROUP)
fn scan_blocks(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = group_index(group);
    let count = scan_length(counters[step.counter]);
    if (block * BLOCK >= count) {
        return;
    }
    let first = block * BLOCK + 4u * lane;
    var own = vec4(0u);
    for (var k = 0u; k < 4u; k++) {
        if (first + k < count) {
            own[k] = values[first + k];
        }
    }
    let sums = sum_before(own.x + own.y + own.z + own.w, lane);
    var sum = sums.x;
    for (var k = 0u; k < 4u; k++) {
        if (first + k < count) {
            values[first + k] = sum;
        }
        sum += own[k];
    }
    if (lane == 0u) {
        block_sums[block] = sums.y;
    }
}

// How many numbers are scanned, for a counter with the value `count`; see ScanStep.
fn scan_length(count: u32) -> u32 {
    return select(count, DIGITS * blocks_of(count), step.digits == 1u);
}
