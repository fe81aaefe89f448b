// The running sum over the invocations of a workgroup.
// Needs: types.

var<workgroup> running: array<u32, GROUP>;

// Returns the sum of the values of all lanes (invocations) before this one, and the sum over all lanes. Every lane of
// the workgroup must call this function.
fn sum_before(value: u32, lane: u32) -> vec2<u32> {
    var sum = value;
    running[lane] = sum;
    for (var reach = 1u; reach < GROUP; reach *= 2u) {
        workgroupBarrier();
        let before = select(0u, running[max(lane, reach) - reach], lane >= reach);
        workgroupBarrier();
        sum += before;
        running[lane] = sum;
    }
    workgroupBarrier();
    let total = running[GROUP - 1u];
    workgroupBarrier();
    return vec2(sum - value, total);
}
