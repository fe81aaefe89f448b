// The SSIM map of each tile and channel: its sum, and its partial derivatives at every pixel. 11 × 11 Gaussian window,
// zeros outside the picture, as in 3DGS.
// Parts: types, pixels, photograph, photometric.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> settings: LossSettings;
@group(0) @binding(2) var<storage, read> image: array<f32>;
@group(0) @binding(3) var<storage, read> photograph: array<u32>;
@group(0) @binding(4) var<storage, read_write> partials: array<f32>;
// By tile and channel, two vectors; this pass writes the first number.
@group(0) @binding(5) var<storage, read_write> sums: array<vec4<f32>>;

// Stabilisers for colours in 0..1 (0.01² and 0.03²).
const SSIM_C1: f32 = 0.0001;
const SSIM_C2: f32 = 0.0009;

// Colours of the tile and its halo: rendered, photographed.
var<workgroup> colors: array<vec2<f32>, SSIM_SIDE * SSIM_SIDE>;
// Filtered along rows: x, y, xx and yy; xy has its own array.
var<workgroup> filtered: array<vec4<f32>, SSIM_SIDE * TILE>;
var<workgroup> products: array<f32, SSIM_SIDE * TILE>;
var<workgroup> totals: array<f32, GROUP>;

@compute @workgroup_size(GROUP)
fn ssim(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let job = job_of(group);
    if (job.tile >= tiles()) {
        return;
    }
    for (var k = lane; k < SSIM_SIDE * SSIM_SIDE; k += GROUP) {
        let pixel = around(job.origin, k);
        var color = vec2(0.0);
        if (is_inside(pixel)) {
            color = vec2(image[pixel_place(view.planes, job.channel, pixel)], photographed(pixel, job.channel));
        }
        colors[k] = color;
    }
    workgroupBarrier();
    var window = SSIM_WINDOW;
    for (var k = lane; k < SSIM_SIDE * TILE; k += GROUP) {
        let first = k / TILE * SSIM_SIDE + k % TILE;
        var sum = vec4(0.0);
        var product = 0.0;
        for (var tap = 0u; tap < SSIM_TAPS; tap++) {
            let color = colors[first + tap];
            sum += window[tap] * vec4(color, color * color);
            product += window[tap] * color.x * color.y;
        }
        filtered[k] = sum;
        products[k] = product;
    }
    workgroupBarrier();
    var m = vec4(0.0);
    var xy = 0.0;
    for (var tap = 0u; tap < SSIM_TAPS; tap++) {
        m += window[tap] * filtered[lane + tap * TILE];
        xy += window[tap] * products[lane + tap * TILE];
    }
    let is_pixel = is_inside(job.origin + vec2(lane % TILE, lane / TILE));
    let here = ssim_here(m, xy);
    let partial = select(vec3(0.0), here.yzw, is_pixel);
    for (var k = 0u; k < 3u; k++) {
        partials[(job.tile * PARTIALS + 3u * job.channel + k) * TILE_PIXELS + lane] = partial[k];
    }
    let total = sum_of_map(select(0.0, here.x, is_pixel), lane);
    if (lane == 0u) {
        sums[LOSS_VECTORS * job.index].x = total;
    }
}

// SSIM, and its derivatives by μx, E[xx] and E[xy], from filtered x, y, xx, yy and xy.
fn ssim_here(m: vec4<f32>, xy: f32) -> vec4<f32> {
    let a1 = 2.0 * m.x * m.y + SSIM_C1;
    let a2 = 2.0 * (xy - m.x * m.y) + SSIM_C2;
    let b1 = m.x * m.x + m.y * m.y + SSIM_C1;
    let b2 = m.z - m.x * m.x + m.w - m.y * m.y + SSIM_C2;
    let inv = 1.0 / (b1 * b2);
    let map = a1 * a2 * inv;
    // By μx directly, and through σx² = E[xx] - μx² and σxy = E[xy] - μx μy.
    let by_mu = 2.0 * (m.y * (a2 - a1) * inv + m.x * map * (1.0 / b2 - 1.0 / b1));
    return vec4(map, by_mu, -map / b2, 2.0 * a1 * inv);
}

// The sum over the lanes, in a fixed order.
fn sum_of_map(value: f32, lane: u32) -> f32 {
    totals[lane] = value;
    for (var reach = GROUP / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if (lane < reach) {
            totals[lane] += totals[lane + reach];
        }
    }
    workgroupBarrier();
    return totals[0];
}
