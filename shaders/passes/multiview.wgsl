// The multi-view losses on sampled pixels (PGSR): the reprojection error through the depth of a neighbouring view, and
// the difference between the patch around the pixel and its warp in the photograph of that view. The homography of the
// blended plane gives the warp. Each invocation processes one sample. No two samples share a pixel.
//
// Reprojection: the point that a pixel shows is projected into the neighbour. The depth of the neighbour at that
// position gives a second point, which is projected back. The error e is the distance of the result from the pixel, px.
// If e < 1, the loss is w e with w = exp(-e). The weight w and the neighbour's depths are held constant.
//
// NCC: let the blended plane of the pixel have normal N and distance D, and let m = N / D. A ray r meets the plane at
// the inverse depth s = -(m . r). In the frame of the neighbour, this point is proportional to R r + s t, with rotation
// R and translation t. The loss of a patch is w (1 - c² / (a b + ε)): a and b are the variances of luma in the patch
// and in its warp, c is their covariance, and ε = VARIANCES_MIN.
// Parts: types, pixels, surface, surface_gradient, samples.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> weights: SurfaceWeights;
@group(0) @binding(2) var<uniform> pair: Pair;
@group(0) @binding(3) var<storage, read> image: array<f32>;
@group(0) @binding(4) var<storage, read> depth: array<f32>;
@group(0) @binding(5) var<storage, read> luma_plane: array<f32>;
@group(0) @binding(6) var<storage, read> neighbour_depth: array<f32>;
@group(0) @binding(7) var<storage, read> neighbour_luma: array<f32>;
@group(0) @binding(8) var<storage, read_write> gradient: array<f32>;
// Loss sums. From `weights.sums_first` on, each workgroup writes one vector: sum of w e, sum of w (1 - NCC²), number of
// samples with an error below 1 px, number of samples whose patches match.
@group(0) @binding(9) var<storage, read_write> sums: array<vec4<f32>>;

// Number of samples that a workgroup processes.
const SAMPLES_AT_ONCE: u32 = 64u;
// A pixel counts as seen by both views if its reprojection error is below this, px (θ in CoSurfGS).
const RETURN_MAX_PX: f32 = 1.0;
// Number of pixels of a patch on each side of its centre: 1 or 3.
override PATCH_REACH: u32;
// Largest number of pixels of a patch.
const PATCH_MAX: u32 = 49u;
// Term that keeps the correlation of patches without contrast finite, for luma in 0..1.
const VARIANCES_MIN: f32 = 1e-8;
// Patches with 1 - NCC² of at least this count as different surfaces (PGSR).
const DISAGREEMENT_MAX: f32 = 0.9;

var<workgroup> totals: array<vec4<f32>, SAMPLES_AT_ONCE>;

@compute @workgroup_size(SAMPLES_AT_ONCE)
fn multiview(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let job = group_index(group);
    let sample = job * SAMPLES_AT_ONCE + lane;
    var loss = vec4(0.0);
    if (sample < weights.samples) {
        loss = sample_loss(sampled_pixel(sample));
    }
    totals[lane] = loss;
    for (var reach = SAMPLES_AT_ONCE / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if (lane < reach) {
            totals[lane] += totals[lane + reach];
        }
    }
    if (lane == 0u && job * SAMPLES_AT_ONCE < weights.samples) {
        sums[weights.sums_first + job] = totals[0];
    }
}

// Adds the gradient of a sample to the gradient of the picture. Returns the contribution of the sample to the sums.
fn sample_loss(pixel: vec2<u32>) -> vec4<f32> {
    if (!is_inside(pixel)) {
        return vec4(0.0);
    }
    let z = depth[line_place(pixel)];
    if (!(z > 0.0) || luma_plane[line_place(pixel)] < 0.0) {
        return vec4(0.0);
    }
    let plane = plane_at(pixel);
    let ray = ray_of(vec2<f32>(pixel));
    let back = reprojection_error(vec2<f32>(pixel), ray, z);
    // A comparison with NaN is false, so a sample with NaN does not count.
    if (!(back.x < RETURN_MAX_PX)) {
        return vec4(0.0);
    }
    let trust = exp(-back.x);
    var v = through_depth(z, ray, plane.w / z, weights.reprojection * trust * back.y);
    var loss = vec4(trust * back.x, 0.0, 1.0, 0.0);
    let alike = patches(pixel, plane);
    if (alike.disagreement < DISAGREEMENT_MAX) {
        loss += vec4(0.0, trust * alike.disagreement, 0.0, 1.0);
        // The gradient with respect to m = N / D becomes gradients with respect to N and D.
        let v_ratio = weights.ncc * trust * alike.by_ratio;
        v += vec4(v_ratio, -dot(v_ratio, plane.xyz) / plane.w) / plane.w;
    }
    add_to_plane(pixel, v);
    return loss;
}

// A point on the screen, px, and its derivative by a parameter, such as depth.
struct Moving {
    at_px: vec2<f32>,
    by_px: vec2<f32>,
}

// The projection of a point, and its derivative; `by` is the derivative of the point.
fn projected(point: vec3<f32>, by: vec3<f32>, focal_px: vec2<f32>, center_px: vec2<f32>) -> Moving {
    let inv_z = 1.0 / point.z;
    let slope = point.xy * inv_z;
    return Moving(focal_px * slope + center_px, focal_px * (by.xy - slope * by.z) * inv_z);
}

fn to_neighbour(v: vec3<f32>) -> vec3<f32> {
    return vec3(
        dot(pair.there_from_here[0].xyz, v), dot(pair.there_from_here[1].xyz, v), dot(pair.there_from_here[2].xyz, v),
    );
}

fn from_neighbour(v: vec3<f32>) -> vec3<f32> {
    return v.x * pair.there_from_here[0].xyz + v.y * pair.there_from_here[1].xyz + v.z * pair.there_from_here[2].xyz;
}

fn translation() -> vec3<f32> {
    return vec3(pair.there_from_here[0].w, pair.there_from_here[1].w, pair.there_from_here[2].w);
}

// The reprojection error of a pixel, px, and its derivative by the depth z of the pixel. If the pixel cannot be
// reprojected, the error is above RETURN_MAX_PX.
fn reprojection_error(pixel: vec2<f32>, ray: vec3<f32>, z: f32) -> vec2<f32> {
    let never = vec2(2.0 * RETURN_MAX_PX, 0.0);
    let by = to_neighbour(ray);
    let there = z * by + translation();
    if (!(there.z > NEAR)) {
        return never;
    }
    let q = projected(there, by, pair.focal_px, pair.center_px);
    let found = bilinear_depth(q.at_px);
    if (!(found.least > 0.0) || bilinear_luma(q.at_px).least < 0.0) {
        return never;
    }
    let by_depth = dot(found.slope, q.by_px);
    let slope = (q.at_px - pair.center_px) / pair.focal_px;
    let hit = found.value * vec3(slope, 1.0);
    let hit_by = vec3(by_depth * slope + found.value * q.by_px / pair.focal_px, by_depth);
    let back = from_neighbour(hit - translation());
    if (!(back.z > NEAR)) {
        return never;
    }
    let p = projected(back, from_neighbour(hit_by), view.focal_px, view.center_px);
    let off = p.at_px - (pixel + 0.5);
    let e = length(off);
    return vec2(e, dot(off, p.by_px) / max(e, 1e-6));
}

// The result of a bilinear interpolation in the depth or luma of the neighbour.
struct Found {
    value: f32,
    // Derivative by x and y, per px.
    slope: vec2<f32>,
    // The smallest of the values of the four pixels around the position; -1 outside the picture.
    least: f32,
}

const NOWHERE = Found(0.0, vec2(0.0), -1.0);

// A position in the picture of the neighbour, between the centres of four pixels.
struct Between {
    // Indices of the upper left and the lower left pixel in `neighbour_depth` and `neighbour_luma`.
    upper: u32,
    lower: u32,
    // Distance from the centre of the upper left pixel to the position, 0..1 px.
    share: vec2<f32>,
    // Whether all four pixels lie in the picture.
    is_inside: bool,
}

fn between(q_px: vec2<f32>) -> Between {
    let at = q_px - 0.5;
    let is_inside = all(at >= vec2(0.0)) && all(at < vec2<f32>(pair.size_px - 1u));
    let corner = vec2<u32>(at);
    let upper = corner.y * pair.size_px.x + corner.x;
    return Between(upper, upper + pair.size_px.x, at - vec2<f32>(corner), is_inside);
}

fn bilinear(upper: vec2<f32>, lower: vec2<f32>, share: vec2<f32>) -> Found {
    let top = upper.y - upper.x;
    let bottom = lower.y - lower.x;
    let left = lower.x - upper.x;
    let right = lower.y - upper.y;
    let value = upper.x + share.x * top + share.y * (left + share.x * (right - left));
    let slope = vec2(top + share.y * (bottom - top), left + share.x * (right - left));
    return Found(value, slope, min(min(upper.x, upper.y), min(lower.x, lower.y)));
}

fn bilinear_depth(q_px: vec2<f32>) -> Found {
    let q = between(q_px);
    if (!q.is_inside) {
        return NOWHERE;
    }
    return bilinear(depths_from(q.upper), depths_from(q.lower), q.share);
}

fn bilinear_luma(q_px: vec2<f32>) -> Found {
    let q = between(q_px);
    if (!q.is_inside) {
        return NOWHERE;
    }
    return bilinear(lumas_from(q.upper), lumas_from(q.lower), q.share);
}

fn depths_from(i: u32) -> vec2<f32> {
    return vec2(neighbour_depth[i], neighbour_depth[i + 1u]);
}

fn lumas_from(i: u32) -> vec2<f32> {
    return vec2(neighbour_luma[i], neighbour_luma[i + 1u]);
}

// 1 - NCC² of a patch and its warp in the neighbour, and the derivative by m = N / D (`by_ratio`).
struct Match {
    disagreement: f32,
    by_ratio: vec3<f32>,
}

// Compares the patch around a pixel with the neighbour. If it cannot be compared, or if the correlation is not
// positive, the disagreement is 1.
fn patches(pixel: vec2<u32>, plane: vec4<f32>) -> Match {
    let none = Match(1.0, vec3(0.0));
    if (any(pixel < vec2(PATCH_REACH)) || any(pixel + PATCH_REACH >= view.size_px)) {
        return none;
    }
    let ratio = plane.xyz / plane.w;
    let t = translation();
    let count = patch_side() * patch_side();
    var here: array<f32, PATCH_MAX>;
    var there: array<f32, PATCH_MAX>;
    // Derivative of the luma in the neighbour by the inverse depth of the plane.
    var slopes: array<f32, PATCH_MAX>;
    var means = vec2(0.0);
    for (var i = 0u; i < count; i++) {
        let at = patch_pixel(pixel, i);
        let r = ray_of(vec2<f32>(at));
        let inverse_depth = -dot(ratio, r);
        let point = to_neighbour(r) + inverse_depth * t;
        // If the plane is behind one of the cameras, there is no match. `point` is the point in the frame of the
        // neighbour times the inverse depth, so NEAR is multiplied by the inverse depth as well.
        if (!(inverse_depth > 0.0 && point.z > NEAR * inverse_depth)) {
            return none;
        }
        let q = projected(point, t, pair.focal_px, pair.center_px);
        let found = bilinear_luma(q.at_px);
        if (found.least < 0.0) {
            return none;
        }
        here[i] = luma_plane[line_place(at)];
        if (here[i] < 0.0) {
            return none;
        }
        there[i] = found.value;
        slopes[i] = dot(found.slope, q.by_px);
        means += vec2(here[i], there[i]);
    }
    means /= f32(count);
    // Variance of the patch here, variance of the patch in the neighbour, and their covariance.
    var moments = vec3(0.0);
    for (var i = 0u; i < count; i++) {
        let a = here[i] - means.x;
        let b = there[i] - means.y;
        moments += vec3(a * a, b * b, a * b);
    }
    moments /= f32(count);
    // Patches without positive correlation do not match (in PGSR, negative correlation matches).
    if (!(moments.z > 0.0)) {
        return none;
    }
    let scale = 1.0 / (moments.x * moments.y + VARIANCES_MIN);
    let agreement = moments.z * scale;
    let by_covariance = -2.0 * agreement / f32(count);
    let by_variance = 2.0 * agreement * agreement * moments.x / f32(count);
    var by_ratio = vec3(0.0);
    for (var i = 0u; i < count; i++) {
        let v_there = by_covariance * (here[i] - means.x) + by_variance * (there[i] - means.y);
        by_ratio -= v_there * slopes[i] * ray_of(vec2<f32>(patch_pixel(pixel, i)));
    }
    return Match(1.0 - moments.z * agreement, by_ratio);
}

// Side of a patch, px.
fn patch_side() -> u32 {
    return 2u * PATCH_REACH + 1u;
}

// The `i`-th pixel of the patch around a pixel.
fn patch_pixel(pixel: vec2<u32>, i: u32) -> vec2<u32> {
    return pixel + vec2(i % patch_side(), i / patch_side()) - PATCH_REACH;
}
