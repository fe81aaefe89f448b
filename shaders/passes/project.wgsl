// Projects each splat for one camera: computes its 2D Gaussian, colour, plane, depth and number of tiles.
// Parts: types, geometry, sh, spans.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> shape: array<f32>;
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read_write> projected: array<Projected>;
// Bits of the depth along the optical axis (positive floats have the same order as their bits), or NOT_SEEN.
@group(0) @binding(4) var<storage, read_write> depth_keys: array<u32>;
// 1 for each visible splat, 0 for the others: input of the next scan.
@group(0) @binding(5) var<storage, read_write> places: array<u32>;
// First slot and number of slots of each splat. This pass writes the number of tiles as the number of slots; the pass
// emit writes the final values.
@group(0) @binding(6) var<storage, read_write> slots: array<vec2<u32>>;

@compute @workgroup_size(GROUP)
fn project(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    if (i >= view.splats) {
        return;
    }
    var key = NOT_SEEN;
    var tiles = 0u;
    let mean = vec3(row(MEAN, i), row(MEAN + 1u, i), row(MEAN + 2u, i));
    let quat = vec4(row(QUAT, i), row(QUAT + 1u, i), row(QUAT + 2u, i), row(QUAT + 3u, i));
    let log_scale = vec3(row(LOG_SCALE, i), row(LOG_SCALE + 1u, i), row(LOG_SCALE + 2u, i));
    let g = geometry(mean, quat, log_scale);
    if (NEAR < g.t.z && g.t.z <= view.far) {
        let splat = seen(g, mean, log_scale, i);
        projected[i] = splat;
        let low = splat.mean_px + splat.extent_px;
        let high = splat.mean_px - splat.extent_px;
        // Comparisons with NaN are false, so splats with NaN are invisible.
        if (splat.falloff_max > 0.0 && all(low >= vec2(0.5)) && all(high <= vec2<f32>(view.size_px) - 0.5)) {
            key = bitcast<u32>(g.t.z);
            tiles = count_tiles(splat);
        }
    }
    if (key == NOT_SEEN) {
        projected[i].falloff_max = 0.0;
    }
    depth_keys[i] = key;
    places[i] = select(0u, 1u, key != NOT_SEEN);
    slots[i] = vec2(0u, tiles);
}

fn row(r: u32, i: u32) -> f32 {
    return shape[r * view.splat_stride + i];
}

fn seen(g: Geometry, mean: vec3<f32>, log_scale: vec3<f32>, i: u32) -> Projected {
    let plane = plane(g, shortest_axis(log_scale));
    let inv_det = 1.0 / g.det;
    // log2(sigmoid(x)), without overflow on either side.
    let logit = row(OPACITY, i);
    let log2_opacity = LOG2_E * (min(logit, 0.0) - ln_1p(exp(max(-abs(logit), -80.0))));
    let falloff_max = log2_opacity - LOG2_ALPHA_MIN;
    // With C the covariance on the screen and A its inverse, alpha is ALPHA_MIN on the ellipse dᵀ A d = reach around
    // the mean. Half the sides of its bounding box are sqrt(reach * C_xx) and sqrt(reach * C_yy).
    let reach = 2.0 / LOG2_E * max(falloff_max, 0.0);
    let half = inv_det * 0.5 * LOG2_E;
    var splat: Projected;
    splat.mean_px = view.focal_px * (g.t.xy * g.inv_z) + view.center_px;
    splat.extent_px = sqrt(reach * g.cov.xz);
    splat.falloff = vec3(g.cov.z * half, -(g.cov.y * inv_det * LOG2_E), g.cov.x * half);
    splat.log2_opacity = log2_opacity;
    splat.rgb = color(mean, i);
    splat.falloff_max = falloff_max;
    splat.normal = plane.normal;
    splat.plane_distance = plane.distance;
    return splat;
}

// ln(1 + x) for x in 0..=1, with an error below 3e-7. It is 2 artanh(s) with s = x / (2 + x), computed as a series up
// to s^11.
fn ln_1p(x: f32) -> f32 {
    let s = x / (x + 2.0);
    let ss = s * s;
    let tail = ((2.0 / 11.0 * ss + 2.0 / 9.0) * ss + 2.0 / 7.0) * ss + 2.0 / 5.0;
    return ((tail * ss + 2.0 / 3.0) * ss + 2.0) * s;
}

fn color(mean: vec3<f32>, i: u32) -> vec3<f32> {
    var basis = sh_basis(view_direction(mean).xyz);
    var rgb = vec3(0.5);
    for (var k = 0u; k < sh_count(view.sh_degree); k++) {
        let at = 3u * k * view.splat_stride + i;
        rgb += basis[k] * vec3(sh[at], sh[at + view.splat_stride], sh[at + 2u * view.splat_stride]);
    }
    return max(rgb, vec3(0.0));
}

fn count_tiles(splat: Projected) -> u32 {
    let rows = tile_rows(splat);
    var tiles = 0u;
    for (var y = rows.x; y < rows.y; y++) {
        let span = tile_span(splat, y);
        tiles += u32(max(span.y - span.x, 0));
    }
    return tiles;
}
