// Adds to the running sums of each block the sum of all blocks before it.
// Parts: types.

@group(0) @binding(0) var<uniform> step: ScanStep;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> values: array<u32>;

@compute @workgroup_size(GROUP)
fn scan_add(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    if (i < counters[step.counter]) {
        values[i] += block_sums[i / BLOCK];
    }
}
