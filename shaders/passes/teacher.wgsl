// The losses of distillation: differences of depths and blended normals from those of a teacher (CoSurfGS, "Model
// Aggregation Scheme", L_d and L_n). A pixel has depth z and blended normal N; those of the teacher are z' and N', and
// t is the trust in the pixel of the teacher. The losses are t |z - z'| and t |N - N'|₁. The loss of depth is 0 unless
// both z and z' are above 0.
// Parts: types, pixels, surface, surface_gradient, tile_sum.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> weights: SurfaceWeights;
@group(0) @binding(2) var<storage, read> image: array<f32>;
@group(0) @binding(3) var<storage, read> depth: array<f32>;
// The surface of the teacher: depths of all pixels row by row, then trusts, then normals.
@group(0) @binding(4) var<storage, read> shown: array<f32>;
@group(0) @binding(5) var<storage, read_write> gradient: array<f32>;
// Loss sums: one vector for each tile. This pass writes the sums of both losses to its last two numbers.
@group(0) @binding(6) var<storage, read_write> sums: array<vec4<f32>>;

@compute @workgroup_size(GROUP)
fn teacher(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = group_index(group);
    if (tile >= tiles()) {
        return;
    }
    let pixel = pixel_of(tile, lane);
    var loss = vec2(0.0);
    if (is_inside(pixel)) {
        loss = teacher_loss(pixel);
    }
    let total = tile_sum(loss, lane);
    if (lane == 0u) {
        sums[tile] = vec4(sums[tile].xy, total);
    }
}

fn teacher_loss(pixel: vec2<u32>) -> vec2<f32> {
    let pixels = view.size_px.x * view.size_px.y;
    let i = line_place(pixel);
    let trust = shown[pixels + i];
    let wanted = 2u * pixels + 3u * i;
    let plane = plane_at(pixel);
    let off = plane.xyz - vec3(shown[wanted], shown[wanted + 1u], shown[wanted + 2u]);
    var v = vec4(trust * weights.teacher_normal * sign(off), 0.0);
    var loss = vec2(0.0, trust * dot(abs(off), vec3(1.0)));
    let z = depth[i];
    if (z > 0.0 && shown[i] > 0.0) {
        let ray = ray_of(vec2<f32>(pixel));
        let v_z = trust * weights.teacher_depth * sign(z - shown[i]);
        v += through_depth(z, ray, -dot(plane.xyz, ray), v_z);
        loss.x = trust * abs(z - shown[i]);
    }
    add_to_plane(pixel, v);
    return loss;
}
