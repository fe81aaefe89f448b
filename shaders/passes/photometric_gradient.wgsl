// Computes the gradient of (1 - λ) L1 + λ (1 - SSIM) with respect to the colours of every pixel, and the sums of the
// colour loss other than SSIM. λ is the weight of SSIM. L1 compares the photograph with gain * colour + offset, SSIM
// with the rendered colour itself. The gradients with respect to all other planes are set to zero.
// Parts: types, pixels, photograph, photometric.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> settings: LossSettings;
@group(0) @binding(2) var<storage, read> image: array<f32>;
@group(0) @binding(3) var<storage, read> photograph: array<u32>;
@group(0) @binding(4) var<storage, read> partials: array<f32>;
// Loss sums: two vectors for each tile and channel. The pass ssim wrote the first number. This pass writes the next
// four, sums over pixels with x the rendered and y the photographed value: (x - y)², |d|, sign(d) and sign(d) * x,
// where d = gain * x + offset - y.
@group(0) @binding(5) var<storage, read_write> sums: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> gradient: array<f32>;

// The first two of the three partial derivatives of SSIM in the tile and its halo; `halo_third` holds the third. `halo`
// is used again for the sums over the lanes.
var<workgroup> halo: array<vec2<f32>, SSIM_SIDE * SSIM_SIDE>;
var<workgroup> halo_third: array<f32, SSIM_SIDE * SSIM_SIDE>;
// The partial derivatives, filtered with the window along rows.
var<workgroup> filtered: array<vec2<f32>, SSIM_SIDE * TILE>;
var<workgroup> filtered_third: array<f32, SSIM_SIDE * TILE>;

@compute @workgroup_size(GROUP)
fn photometric_gradient(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let job = job_of(group);
    if (job.tile >= tiles()) {
        return;
    }
    for (var k = lane; k < SSIM_SIDE * SSIM_SIDE; k += GROUP) {
        let pixel = around(job.origin, k);
        var partial = vec3(0.0);
        if (is_inside(pixel)) {
            let at = pixel_place(PARTIALS, 3u * job.channel, pixel);
            partial = vec3(partials[at], partials[at + TILE_PIXELS], partials[at + 2u * TILE_PIXELS]);
        }
        halo[k] = partial.xy;
        halo_third[k] = partial.z;
    }
    workgroupBarrier();
    var window = SSIM_WINDOW;
    for (var k = lane; k < SSIM_SIDE * TILE; k += GROUP) {
        let first = k / TILE * SSIM_SIDE + k % TILE;
        var sum = vec3(0.0);
        for (var tap = 0u; tap < SSIM_TAPS; tap++) {
            sum += window[tap] * vec3(halo[first + tap], halo_third[first + tap]);
        }
        filtered[k] = sum.xy;
        filtered_third[k] = sum.z;
    }
    workgroupBarrier();
    var p = vec3(0.0);
    for (var tap = 0u; tap < SSIM_TAPS; tap++) {
        let at = lane + tap * TILE;
        p += window[tap] * vec3(filtered[at], filtered_third[at]);
    }
    let pixel = job.origin + vec2(lane % TILE, lane / TILE);
    var slope = 0.0;
    var differences = vec4(0.0);
    if (is_inside(pixel) && !is_masked(3u * line_place(pixel))) {
        let x = image[pixel_place(view.planes, job.channel, pixel)];
        let y = photographed(pixel, job.channel);
        let exposed = x * settings.gain + settings.offset - y;
        let side = sign(exposed);
        let d_ssim = 2.0 * x * p.y + (y * p.z + p.x);
        slope = side * settings.l1_weight * settings.gain - settings.ssim_weight * d_ssim;
        differences = vec4((x - y) * (x - y), abs(exposed), side, side * x);
    }
    gradient[(job.tile * view.planes + job.channel) * TILE_PIXELS + lane] = slope;
    for (var plane = 3u + job.channel; plane < view.planes; plane += 3u) {
        gradient[(job.tile * view.planes + plane) * TILE_PIXELS + lane] = 0.0;
    }
    let total = sum_of_differences(differences, lane);
    if (lane == 0u) {
        sums[LOSS_VECTORS * job.index].y = total.x;
        sums[LOSS_VECTORS * job.index].z = total.y;
        sums[LOSS_VECTORS * job.index].w = total.z;
        sums[LOSS_VECTORS * job.index + 1u] = vec4(total.w, 0.0, 0.0, 0.0);
    }
}

// The sum of `value` over all lanes, in a fixed order.
fn sum_of_differences(value: vec4<f32>, lane: u32) -> vec4<f32> {
    halo[2u * lane] = value.xy;
    halo[2u * lane + 1u] = value.zw;
    for (var reach = GROUP / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if (lane < reach) {
            halo[2u * lane] += halo[2u * (lane + reach)];
            halo[2u * lane + 1u] += halo[2u * (lane + reach) + 1u];
        }
    }
    workgroupBarrier();
    return vec4(halo[0], halo[1]);
}
