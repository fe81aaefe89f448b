// The sum of a value over the pixels of a tile, in a fixed order. Every invocation of the workgroup must call this.
// Needs: types.

var<workgroup> lanes: array<vec2<f32>, GROUP>;

fn tile_sum(value: vec2<f32>, lane: u32) -> vec2<f32> {
    lanes[lane] = value;
    for (var reach = GROUP / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if (lane < reach) {
            lanes[lane] += lanes[lane + reach];
        }
    }
    workgroupBarrier();
    return lanes[0];
}
