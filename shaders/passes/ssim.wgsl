// Computes the SSIM of every pixel in each channel: its sum over each tile, and its partial derivatives at every pixel.
// As in 3DGS, the window is Gaussian with 11 × 11 px, and pixels outside the picture are zero.
// Parts: types, pixels, photograph, photometric.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> settings: LossSettings;
@group(0) @binding(2) var<storage, read> image: array<f32>;
@group(0) @binding(3) var<storage, read> photograph: array<u32>;
@group(0) @binding(4) var<storage, read_write> partials: array<f32>;
// Loss sums: two vectors for each tile and channel. This pass writes their first number, the sum of SSIM.
@group(0) @binding(5) var<storage, read_write> sums: array<vec4<f32>>;

// Terms that keep the divisions of SSIM finite, for colours in 0..1 (0.01² and 0.03²).
const SSIM_C1: f32 = 0.0001;
const SSIM_C2: f32 = 0.0009;

// Values of the channel in the tile and its halo: rendered (x), then photographed (y).
var<workgroup> colors: array<vec2<f32>, SSIM_SIDE * SSIM_SIDE>;
// x, y, x² and y², filtered with the window along rows. The array `products` holds x y, filtered in the same way.
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
            // A masked pixel looks as the photograph does in the windows of the pixels around it.
            color.y = select(color.y, color.x, is_masked(3u * line_place(pixel)));
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
    let pixel = job.origin + vec2(lane % TILE, lane / TILE);
    let is_pixel = is_inside(pixel);
    var here = ssim_here(m, xy);
    if (is_pixel && is_masked(3u * line_place(pixel))) {
        here = vec4(1.0, 0.0, 0.0, 0.0);
    }
    let partial = select(vec3(0.0), here.yzw, is_pixel);
    for (var k = 0u; k < 3u; k++) {
        partials[(job.tile * PARTIALS + 3u * job.channel + k) * TILE_PIXELS + lane] = partial[k];
    }
    let total = sum_of_map(select(0.0, here.x, is_pixel), lane);
    if (lane == 0u) {
        sums[LOSS_VECTORS * job.index].x = total;
    }
}

// SSIM of a pixel, and its derivatives by μx, E[xx] and E[xy], the means of x, x² and x y over the window. `m` holds
// the means of x, y, x² and y²; `xy` is that of x y.
fn ssim_here(m: vec4<f32>, xy: f32) -> vec4<f32> {
    let a1 = 2.0 * m.x * m.y + SSIM_C1;
    let a2 = 2.0 * (xy - m.x * m.y) + SSIM_C2;
    let b1 = m.x * m.x + m.y * m.y + SSIM_C1;
    let b2 = m.z - m.x * m.x + m.w - m.y * m.y + SSIM_C2;
    let inv = 1.0 / (b1 * b2);
    let map = a1 * a2 * inv;
    // The derivative by μx has a direct part, and parts through σx² = E[xx] - μx² and σxy = E[xy] - μx μy.
    let by_mu = 2.0 * (m.y * (a2 - a1) * inv + m.x * map * (1.0 / b2 - 1.0 / b1));
    return vec4(map, by_mu, -map / b2, 2.0 * a1 * inv);
}

// The sum of `value` over all lanes, in a fixed order.
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
