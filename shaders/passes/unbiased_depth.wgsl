// The unbiased depth (PGSR): the depth z = D / -(N . r) at which the ray r of a pixel meets the blended plane with
// distance D and normal N. D and N are blended with the same weights, so alpha cancels. The depth is 0 where there is
// no surface.
// Parts: types, pixels, surface.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> image: array<f32>;
@group(0) @binding(2) var<storage, read_write> depth: array<f32>;

@compute @workgroup_size(GROUP)
fn unbiased_depth(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let pixel = pixel_of(group_index(group), lane);
    if (!is_inside(pixel)) {
        return;
    }
    let plane = plane_at(pixel);
    let facing = -dot(plane.xyz, ray_of(vec2<f32>(pixel)));
    let alpha = alpha_at(pixel);
    var z = 0.0;
    if (alpha >= SURFACE_ALPHA && facing >= GRAZING * alpha) {
        z = plane.w / facing;
    }
    depth[line_place(pixel)] = z;
}
