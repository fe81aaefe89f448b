// Replaces the sum of each block by the sum of all blocks before it, and writes the total. Runs as one workgroup.
// Parts: types, group_scan.

@group(0) @binding(0) var<uniform> step: ScanStep;
@group(0) @binding(1) var<storage, read_write> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> block_sums: array<u32>;

var<workgroup> shared_blocks: u32;

@compute @workgroup_size(GROUP)
fn scan_sums(@builtin(local_invocation_index) lane: u32) {
    if (lane == 0u) {
        let count = counters[step.counter];
        shared_blocks = blocks_of(select(count, DIGITS * blocks_of(count), step.digits == 1u));
    }
    let blocks = workgroupUniformLoad(&shared_blocks);
    var before = 0u;
    for (var first = 0u; first < blocks; first += GROUP) {
        let own = select(0u, block_sums[min(first + lane, blocks - 1u)], first + lane < blocks);
        let sums = sum_before(own, lane);
        if (first + lane < blocks) {
            block_sums[first + lane] = before + sums.x;
        }
        before += sums.y;
    }
    if (lane == 0u) {
        counters[step.total] = before;
    }
}
