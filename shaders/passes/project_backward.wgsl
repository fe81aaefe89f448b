// The backward pass of the projection. It sums up the records of each splat in the order of their slots, and propagates
// these gradients through 2D Gaussian, plane and colour to the parameters. It also adds to the densification
// statistics. The functions reverse those in geometry.wgsl and sh.wgsl.
//
// A name that begins with v_ is the gradient of the loss L with respect to the rest of the name.
// Parts: types, geometry, sh.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> weights: BackwardWeights;
@group(0) @binding(2) var<storage, read> shape: array<f32>;
@group(0) @binding(3) var<storage, read> sh: array<f32>;
@group(0) @binding(4) var<storage, read> projected: array<Projected>;
@group(0) @binding(5) var<storage, read> slots: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read> records: array<vec4<f32>>;
// Rows as in a shape, then the gradient with respect to the colour that the camera sees; zero for invisible splats.
@group(0) @binding(7) var<storage, read_write> gradients: array<f32>;
// Three rows of sums over views. First: the norm of ∂L/∂mean on the screen, with screen positions in units of half the
// picture (3DGS). Second: 1 for each view that sees the splat. Third: as the first, but each axis of ∂L/∂mean is a sum
// over pixels of absolute values (AbsGS).
@group(0) @binding(8) var<storage, read_write> stats: array<f32>;

@compute @workgroup_size(GROUP)
fn project_backward(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let i = group_index(group) * GROUP + lane;
    if (i >= view.splats) {
        return;
    }
    if (!(projected[i].falloff_max > 0.0)) {
        for (var r = 0u; r < GRADIENT_ROWS; r++) {
            gradients[r * view.splat_stride + i] = 0.0;
        }
        return;
    }
    let sums = gather(slots[i]);
    let mean = vec3(row(MEAN, i), row(MEAN + 1u, i), row(MEAN + 2u, i));
    let quat = vec4(row(QUAT, i), row(QUAT + 1u, i), row(QUAT + 2u, i), row(QUAT + 3u, i));
    let log_scale = vec3(row(LOG_SCALE, i), row(LOG_SCALE + 1u, i), row(LOG_SCALE + 2u, i));
    let g = geometry(mean, quat, log_scale);
    let axis = shortest_axis(log_scale);

    let v_mean_px = screen_mean(g, sums);
    var into = CameraGradients();
    var v_log_scale = through_covariance(g, screen_covariance(g, sums), &into);
    v_log_scale[axis] += weights.scale * g.scale[axis];
    through_mean(g, v_mean_px, &into);
    through_plane(g, axis, sums.surface, &into);
    // A colour channel that is 0 was clamped, so it has no gradient.
    let v_rgb = select(vec3(0.0), sums.rgb, projected[i].rgb > vec3(0.0));
    let v_mean = from_camera(into.t) + through_direction(mean, v_rgb, i);
    // The first moment is ∂L/∂ln o with o the opacity, and ∂ln o/∂logit = 1 - o.
    let v_opacity = sums.moments[0].x / (1.0 + exp(clamp(row(OPACITY, i), -80.0, 80.0)));
    let v_quat = through_rotation(g, into);

    for (var k = 0u; k < 3u; k++) {
        put(MEAN + k, i, v_mean[k]);
        put(LOG_SCALE + k, i, v_log_scale[k]);
        put(GRADIENT_RGB + k, i, v_rgb[k]);
    }
    for (var k = 0u; k < 4u; k++) {
        put(QUAT + k, i, v_quat[k]);
    }
    put(OPACITY, i, v_opacity);
    let half = 0.5 * vec2<f32>(view.size_px);
    stats[STAT_SCREEN_GRADIENT * view.splat_stride + i] += length(v_mean_px * half);
    stats[STAT_VIEWS * view.splat_stride + i] += 1.0;
    stats[STAT_ABSOLUTE_GRADIENT * view.splat_stride + i] += length(sums.absolute * LN_2 * half);
}

fn row(r: u32, i: u32) -> f32 {
    return shape[r * view.splat_stride + i];
}

fn put(r: u32, i: u32, value: f32) {
    gradients[r * view.splat_stride + i] = value;
}

// The sums of the records of a splat; see rasterize_backward.wgsl.
struct Sums {
    // Σq, Σq dx, Σq dy, then Σq dx², Σq dx dy, Σq dy².
    moments: array<vec3<f32>, 2>,
    rgb: vec3<f32>,
    // Gradients with respect to normal (xyz) and distance of the plane.
    surface: vec4<f32>,
    absolute: vec2<f32>,
}

// Sums up the records of the slots of a splat.
fn gather(slots: vec2<u32>) -> Sums {
    var a = vec4(0.0);
    var b = vec4(0.0);
    var c = vec4(0.0);
    var d = vec4(0.0);
    for (var slot = slots.x; slot < slots.x + slots.y; slot++) {
        a += records[RECORD_VECTORS * slot];
        b += records[RECORD_VECTORS * slot + 1u];
        c += records[RECORD_VECTORS * slot + 2u];
        d += records[RECORD_VECTORS * slot + 3u];
    }
    let moments = array(a.xyz, vec3(a.w, b.xy));
    return Sums(moments, vec3(b.zw, c.x), vec4(c.yzw, d.x), d.yz);
}

// Gradient with respect to the mean on the screen: -A (Σq d), with A the inverse of the covariance on the screen.
fn screen_mean(g: Geometry, sums: Sums) -> vec2<f32> {
    let d = sums.moments[0].yz;
    let conic = vec3(g.cov.z, -g.cov.y, g.cov.x) / g.det;
    return -vec2(conic.x * d.x + conic.y * d.y, conic.y * d.x + conic.z * d.y);
}

// Gradient with respect to the covariance on the screen: ½ A (Σq d dᵀ) A as (xx, xy, yy), with A the inverse of the
// covariance. `xy` is one of the two equal entries beside the diagonal, not their sum.
fn screen_covariance(g: Geometry, sums: Sums) -> vec3<f32> {
    let conic = vec3(g.cov.z, -g.cov.y, g.cov.x) / g.det;
    let dd = sums.moments[1];
    let p_x = vec2(conic.x * dd.x + conic.y * dd.y, conic.x * dd.y + conic.y * dd.z);
    let p_y = vec2(conic.y * dd.x + conic.z * dd.y, conic.y * dd.y + conic.z * dd.z);
    return 0.5 * vec3(dot(p_x, conic.xy), dot(p_x, conic.yz), dot(p_y, conic.yz));
}

// Gradients with respect to the mean of the splat in the camera frame (t), and to the axes of the splat (the columns of
// u).
struct CameraGradients {
    t: vec3<f32>,
    u: mat3x3<f32>,
}

// Propagates the gradient through the covariance C = B S² Bᵀ, with B = J u, J the Jacobian of the projection and S the
// scales. Adds the gradients with respect to axes and mean to `into`, and returns that with respect to the log scales.
fn through_covariance(g: Geometry, v_cov: vec3<f32>, into: ptr<function, CameraGradients>) -> vec3<f32> {
    let scaled = 2.0 * g.scale * g.scale;
    let v_b_x = scaled * (v_cov.x * g.b_x + v_cov.y * g.b_y);
    let v_b_y = scaled * (v_cov.y * g.b_x + v_cov.z * g.b_y);
    let j = view.focal_px * g.inv_z;
    let u_z = vec3(g.u[0].z, g.u[1].z, g.u[2].z);
    let v_slope = -j * vec2(dot(v_b_x, u_z), dot(v_b_y, u_z));
    let free = select(v_slope, vec2(0.0), g.clamped);
    // b_x and b_y have the form b = j w with j = f / z. The gradient with respect to j is v_b . w = v_b . b / j. The
    // slope in w depends on z too; the next lines add that part.
    let v_z_of_j = -(dot(v_b_x, g.b_x) + dot(v_b_y, g.b_y)) * g.inv_z;
    (*into).t += vec3(free * g.inv_z, v_z_of_j - dot(free, g.slope) * g.inv_z);
    for (var k = 0u; k < 3u; k++) {
        let v = j * vec2(v_b_x[k], v_b_y[k]);
        (*into).u[k] += vec3(v, -dot(g.slope, v));
    }
    return g.b_x * v_b_x + g.b_y * v_b_y;
}

// Propagates the gradient through the mean on the screen, f * t.xy / z + c, with focal length f and centre c. Its
// slopes are not clamped.
fn through_mean(g: Geometry, v_mean_px: vec2<f32>, into: ptr<function, CameraGradients>) {
    let scaled = v_mean_px * view.focal_px * g.inv_z;
    (*into).t += vec3(scaled, -dot(scaled, g.t.xy) * g.inv_z);
}

// Propagates the gradient through the plane: its normal is n = ± u[axis], its distance -n . t.
fn through_plane(g: Geometry, axis: u32, v_surface: vec4<f32>, into: ptr<function, CameraGradients>) {
    let plane = plane(g, axis);
    (*into).u[axis] += (v_surface.xyz - v_surface.w * g.t) * plane.sign;
    (*into).t -= v_surface.w * plane.normal;
}

// The gradient with respect to the mean in the world, from the colour, which depends on the viewing direction.
fn through_direction(mean: vec3<f32>, v_rgb: vec3<f32>, i: u32) -> vec3<f32> {
    let seen = view_direction(mean);
    var coefficients = array<f32, 16>();
    for (var k = 1u; k < sh_count(view.sh_degree); k++) {
        let at = 3u * k * view.splat_stride + i;
        coefficients[k] = dot(v_rgb, vec3(sh[at], sh[at + view.splat_stride], sh[at + 2u * view.splat_stride]));
    }
    let v_dir = sh_gradient(seen.xyz, coefficients);
    return (v_dir - seen.xyz * dot(seen.xyz, v_dir)) * seen.w;
}

// Σ_k w[k] ∇basis_k at a direction. The caller then removes the part along the direction, since directions have unit
// length.
fn sh_gradient(dir: vec3<f32>, w: array<f32, 16>) -> vec3<f32> {
    let x = dir.x;
    let y = dir.y;
    let z = dir.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    let first = SH_C1 * vec3(-w[3], -w[1], w[2]);
    // The signs and factors use that SH_C2[0] = -SH_C2[1] = -SH_C2[3] = 2 SH_C2[4].
    let second = vec3(
        SH_C2[0] * (w[4] * y - w[7] * z + w[8] * x) - (2.0 * SH_C2[2]) * w[6] * x,
        SH_C2[0] * (w[4] * x - w[5] * z - w[8] * y) - (2.0 * SH_C2[2]) * w[6] * y,
        SH_C2[1] * (w[5] * y + w[7] * x) + (4.0 * SH_C2[2]) * w[6] * z,
    );
    let w9 = SH_C3[0] * w[9];
    let w10 = SH_C3[1] * w[10];
    let w11 = SH_C3[2] * w[11];
    let w12 = SH_C3[3] * w[12];
    let w13 = SH_C3[4] * w[13];
    let w14 = SH_C3[5] * w[14];
    let w15 = SH_C3[6] * w[15];
    let third = vec3(
        6.0 * w9 * x * y + w10 * y * z - 2.0 * w11 * x * y - 6.0 * w12 * x * z
            + w13 * (4.0 * zz - 3.0 * xx - yy) + 2.0 * w14 * x * z + 3.0 * w15 * (xx - yy),
        3.0 * w9 * (xx - yy) + w10 * x * z + w11 * (4.0 * zz - xx - 3.0 * yy)
            - 6.0 * w12 * y * z - 2.0 * w13 * x * y - 2.0 * w14 * y * z - 6.0 * w15 * x * y,
        w10 * x * y + 8.0 * w11 * y * z + w12 * (6.0 * zz - 3.0 * (xx + yy)) + 8.0 * w13 * x * z + w14 * (xx - yy),
    );
    return first + second + third;
}

// Rotates a vector from the camera frame into the world.
fn from_camera(v: vec3<f32>) -> vec3<f32> {
    return v.x * view.cam_from_world[0].xyz + v.y * view.cam_from_world[1].xyz + v.z * view.cam_from_world[2].xyz;
}

// The gradient with respect to the quaternion (wxyz) as it is stored, before its normalisation.
fn through_rotation(g: Geometry, into: CameraGradients) -> vec4<f32> {
    // The columns are the gradients with respect to the axes of the splat in the world.
    let m = mat3x3(from_camera(into.u[0]), from_camera(into.u[1]), from_camera(into.u[2]));
    let w = g.q.x;
    let x = g.q.y;
    let y = g.q.z;
    let z = g.q.w;
    let turn = vec3(m[1].z - m[2].y, m[2].x - m[0].z, m[0].y - m[1].x);
    let xy = m[1].x + m[0].y;
    let xz = m[2].x + m[0].z;
    let yz = m[2].y + m[1].z;
    let v = 2.0 * vec4(
        dot(vec3(x, y, z), turn),
        y * xy + z * xz + w * turn.x - 2.0 * x * (m[1].y + m[2].z),
        x * xy + z * yz + w * turn.y - 2.0 * y * (m[0].x + m[2].z),
        x * xz + y * yz + w * turn.z - 2.0 * z * (m[0].x + m[1].y),
    );
    return (v - g.q * dot(g.q, v)) * g.inv_norm;
}
