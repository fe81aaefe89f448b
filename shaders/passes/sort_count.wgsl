// Counts how often each value of the current digit (8 bits) occurs in each block of keys. The count goes to
// counts[digit * blocks + block]. A workgroup has as many lanes (invocations) as a digit has values.
// Parts: types.

@group(0) @binding(0) var<uniform> step: SortStep;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;

var<workgroup> histogram: array<atomic<u32>, DIGITS>;

@compute @workgroup_size(GROUP)
fn sort_count(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = group_index(group);
    let count = counters[step.counter];
    if (block * BLOCK >= count) {
        return;
    }
    atomicStore(&histogram[lane], 0u);
    workgroupBarrier();
    for (var k = lane; k < BLOCK; k += GROUP) {
        let at = block * BLOCK + k;
        if (at < count) {
            atomicAdd(&histogram[(keys[at] >> step.shift) & (DIGITS - 1u)], 1u);
        }
    }
    workgroupBarrier();
    counts[lane * blocks_of(count) + block] = atomicLoad(&histogram[lane]);
}
