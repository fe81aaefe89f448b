// The single-view normal loss: the difference between blended normals and normals from depth, with lower weight on
// edges of the photograph (PGSR).
//
// A pixel with depth z and ray r shows the point P = z r. The normal from depth at a pixel (x, y) is
// n = h × v / |h × v| with h = P(x + k, y) - P(x - k, y), v = P(x, y - k) - P(x, y + k) and k = NORMAL_REACH.
// The loss of a pixel is w |α n - N|₁: w is the weight for edges, N the blended normal, and α the alpha of the pixel,
// held constant. The loss is 0 if one of the four pixels is outside the picture or has no depth,
// or if one of them or the pixel is masked.
// Parts: types, pixels, surface, luma_slope, tile_sum.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> weights: SurfaceWeights;
@group(0) @binding(2) var<storage, read> image: array<f32>;
@group(0) @binding(3) var<storage, read> depth: array<f32>;
@group(0) @binding(4) var<storage, read> luma_plane: array<f32>;
// Bits of the smallest and the largest slope of the photograph.
@group(0) @binding(5) var<storage, read> slopes: array<u32>;
// Gradient of the loss with respect to the picture. This pass overwrites the planes of normal and distance.
@group(0) @binding(6) var<storage, read_write> gradient: array<f32>;
// Gradient of the loss of each pixel with respect to the depths of the pixels to its right and left, above and below.
@group(0) @binding(7) var<storage, read_write> given: array<vec4<f32>>;
// Loss sums: one vector for each tile. This pass writes the sum of its losses to the first number, and zeros to the
// others.
@group(0) @binding(8) var<storage, read_write> sums: array<vec4<f32>>;

// Gradients of the loss of a pixel with respect to its blended normal and the four depths, and the loss.
struct Given {
    normal: vec3<f32>,
    depths: vec4<f32>,
    loss: f32,
}

@compute @workgroup_size(GROUP)
fn normals(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = group_index(group);
    if (tile >= tiles()) {
        return;
    }
    let pixel = pixel_of(tile, lane);
    var own = Given();
    if (all(pixel >= vec2(NORMAL_REACH)) && all(pixel + NORMAL_REACH < view.size_px)) {
        own = normal_loss(pixel);
    }
    let at = pixel_place(view.planes, NORMAL, pixel);
    for (var k = 0u; k < 3u; k++) {
        gradient[at + k * TILE_PIXELS] = own.normal[k];
    }
    gradient[at + 3u * TILE_PIXELS] = 0.0;
    if (is_inside(pixel)) {
        given[line_place(pixel)] = own.depths;
    }
    let total = tile_sum(vec2(own.loss, 0.0), lane);
    if (lane == 0u) {
        sums[tile] = vec4(total, 0.0, 0.0);
    }
}

fn normal_loss(pixel: vec2<u32>) -> Given {
    let at = line_place(pixel);
    let below = NORMAL_REACH * view.size_px.x;
    let z = vec4(depth[at + NORMAL_REACH], depth[at - NORMAL_REACH], depth[at - below], depth[at + below]);
    let ray = ray_of(vec2<f32>(pixel));
    let across = vec3(f32(NORMAL_REACH) / view.focal_px.x, 0.0, 0.0);
    let down = vec3(0.0, f32(NORMAL_REACH) / view.focal_px.y, 0.0);
    let h = z.x * (ray + across) - z.y * (ray - across);
    let v = z.z * (ray - down) - z.w * (ray + down);
    let c = cross(h, v);
    let length2 = dot(c, c);
    if (!(all(z > vec4(0.0)) && length2 > 1e-30) || is_beside_mask(pixel)) {
        return Given();
    }
    let inv_length = 1.0 / sqrt(length2);
    let n = c * inv_length;
    let alpha = alpha_at(pixel);
    let difference = alpha * n - plane_at(pixel).xyz;
    let w = edge_weight(pixel);
    let v_difference = sign(difference) * (weights.normal * w);
    let g = v_difference * alpha;
    let v_c = (g - n * dot(n, g)) * inv_length;
    let v_h = cross(v, v_c);
    let v_v = cross(v_c, h);
    let depths = vec4(
        dot(v_h, ray + across), -dot(v_h, ray - across), dot(v_v, ray - down), -dot(v_v, ray + down),
    );
    return Given(-v_difference, depths, w * dot(abs(difference), vec3(1.0)));
}

// Weight of a pixel: (1 - g)², with g the slope of the photograph at the pixel, scaled so that slopes over the picture
// range over 0..1. The weight is 1 if all slopes are equal.
fn edge_weight(pixel: vec2<u32>) -> f32 {
    let least = bitcast<f32>(slopes[0]);
    let range = bitcast<f32>(slopes[1]) - least;
    if (!(range > 0.0)) {
        return 1.0;
    }
    let flatness = 1.0 - (luma_slope(pixel) - least) / range;
    return flatness * flatness;
}
