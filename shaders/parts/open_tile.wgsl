// Whether a tile has pixels that are not full yet.
// Needs: types.

var<workgroup> open_pixels: atomic<u32>;
var<workgroup> is_open: u32;

// Whether `open` is true for any invocation. The barriers also ensure that all invocations have finished a batch before
// the next batch overwrites it.
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
