// One step of Adam on all splats, visible or not. This pass also computes the gradient with respect to each SH
// coefficient: the gradient with respect to the colour times the basis function.
// Parts: types, sh.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> rates: Rates;
@group(0) @binding(2) var<storage, read_write> shape: array<f32>;
@group(0) @binding(3) var<storage, read_write> sh: array<f32>;
@group(0) @binding(4) var<storage, read_write> shape_first: array<f32>;
@group(0) @binding(5) var<storage, read_write> shape_second: array<f32>;
@group(0) @binding(6) var<storage, read_write> sh_first: array<f32>;
@group(0) @binding(7) var<storage, read_write> sh_second: array<f32>;
@group(0) @binding(8) var<storage, read> gradients: array<f32>;

// Decays of the first and the second moment, and the term that keeps the division finite (3DGS).
const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

@compute @workgroup_size(GROUP)
fn adam(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    if (i >= view.splats) {
        return;
    }
    let stride = view.splat_stride;
    // The basis needs the viewing direction of the forward pass, so it is computed before the mean moves.
    let mean = vec3(shape[i], shape[stride + i], shape[2u * stride + i]);
    var basis = sh_basis(view_direction(mean).xyz);
    for (var r = 0u; r < GRADIENT_RGB; r++) {
        let at = r * stride + i;
        let update = moments(gradients[at], shape_first[at], shape_second[at]);
        shape_first[at] = update.x;
        shape_second[at] = update.y;
        shape[at] -= shape_rate(r) * rates.first_correction * update.z;
    }
    let rgb_at = GRADIENT_RGB * stride + i;
    let v_rgb = vec3(gradients[rgb_at], gradients[rgb_at + stride], gradients[rgb_at + 2u * stride]);
    for (var k = 0u; k < sh_count(view.sh_degree); k++) {
        let rate = select(rates.sh_rest, rates.sh_dc, k == 0u);
        for (var channel = 0u; channel < 3u; channel++) {
            let at = (3u * k + channel) * stride + i;
            let update = moments(basis[k] * v_rgb[channel], sh_first[at], sh_second[at]);
            sh_first[at] = update.x;
            sh_second[at] = update.y;
            sh[at] -= rate * rates.first_correction * update.z;
        }
    }
}

// First and second moment after a gradient, and the update without learning rate and first bias correction.
fn moments(gradient: f32, first: f32, second: f32) -> vec3<f32> {
    let a = BETA_1 * first + (1.0 - BETA_1) * gradient;
    let b = BETA_2 * second + (1.0 - BETA_2) * gradient * gradient;
    return vec3(a, b, a / (sqrt(b * rates.second_correction) + EPSILON));
}

// Learning rate of row `r` of the shapes.
fn shape_rate(r: u32) -> f32 {
    if (r < QUAT) {
        return rates.mean;
    }
    if (r < LOG_SCALE) {
        return rates.quat;
    }
    return select(rates.opacity, rates.log_scale, r < OPACITY);
}
