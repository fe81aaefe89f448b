// Computes the 2D Gaussian and the plane of a splat from its parameters, for the projection and its backward pass. The
// Gaussian is that of EWA splatting as in 3DGS, the plane that of PGSR.
// Needs: types; the binding `view`.

// Intermediate results of the projection of a splat.
struct Geometry {
    // Mean of the splat in the camera frame.
    t: vec3<f32>,
    inv_z: f32,
    // Slopes x / z and y / z after clamping, and whether they were clamped.
    slope: vec2<f32>,
    clamped: vec2<bool>,
    // Normalised quaternion wxyz, and 1 / length of the quaternion before normalisation.
    q: vec4<f32>,
    inv_norm: f32,
    // Rotation from the splat to the camera frame. Its columns are the axes of the splat.
    u: mat3x3<f32>,
    // Scales along the splat's axes.
    scale: vec3<f32>,
    // The two rows of J u, with J the Jacobian of the projection: for x and y on the screen, how far one world unit
    // along each axis of the splat reaches, px.
    b_x: vec3<f32>,
    b_y: vec3<f32>,
    // Covariance on the screen (xx, xy, yy), including the low-pass filter, px².
    cov: vec3<f32>,
    // Determinant of the covariance `cov`.
    det: f32,
}

// Rotates a vector from the world into the camera frame.
fn to_camera(v: vec3<f32>) -> vec3<f32> {
    return vec3(
        dot(view.cam_from_world[0].xyz, v),
        dot(view.cam_from_world[1].xyz, v),
        dot(view.cam_from_world[2].xyz, v),
    );
}

// Rotation matrix of a unit quaternion wxyz. Its columns are the axes of the splat in the world.
fn rotation(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3(
        vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}

fn geometry(mean: vec3<f32>, quat: vec4<f32>, log_scale: vec3<f32>) -> Geometry {
    var g: Geometry;
    let translation = vec3(view.cam_from_world[0].w, view.cam_from_world[1].w, view.cam_from_world[2].w);
    g.t = to_camera(mean) + translation;
    g.inv_z = 1.0 / g.t.z;
    let raw = g.t.xy * g.inv_z;
    g.slope = min(max(raw, view.slope_min), view.slope_max);
    g.clamped = raw != g.slope;
    g.inv_norm = 1.0 / sqrt(dot(quat, quat));
    g.q = quat * g.inv_norm;
    let r = rotation(g.q);
    g.u = mat3x3(to_camera(r[0]), to_camera(r[1]), to_camera(r[2]));
    g.scale = exp(min(max(log_scale, vec3(-40.0)), vec3(40.0)));
    // J is the Jacobian of the projection to pixels. Its rows are j.x * [1, 0, -slope.x] and j.y * [0, 1, -slope.y].
    // Here j is the focal length along each screen axis, divided by z.
    let u_x = vec3(g.u[0].x, g.u[1].x, g.u[2].x);
    let u_y = vec3(g.u[0].y, g.u[1].y, g.u[2].y);
    let u_z = vec3(g.u[0].z, g.u[1].z, g.u[2].z);
    let j = view.focal_px * g.inv_z;
    g.b_x = j.x * (u_x - g.slope.x * u_z);
    g.b_y = j.y * (u_y - g.slope.y * u_z);
    let s_x = g.b_x * g.scale;
    let s_y = g.b_y * g.scale;
    let bare = vec3(dot(s_x, s_x), dot(s_x, s_y), dot(s_y, s_y));
    // With S the matrix of the rows s_x and s_y, the covariance is S Sᵀ + λ I, with λ = LOW_PASS_PX2. Its determinant
    // is |s_x × s_y|² + λ trace(S Sᵀ) + λ². Unlike xx * yy - xy², this has no cancellation for very thin splats.
    let normal = cross(s_x, s_y);
    g.det = dot(normal, normal) + LOW_PASS_PX2 * (bare.x + bare.z + LOW_PASS_PX2);
    g.cov = bare + vec3(LOW_PASS_PX2, 0.0, LOW_PASS_PX2);
    return g;
}

// Index of the shortest axis; of equally short axes, the last.
fn shortest_axis(log_scale: vec3<f32>) -> u32 {
    if (log_scale.x < log_scale.y && log_scale.x < log_scale.z) {
        return 0u;
    }
    return select(2u, 1u, log_scale.y < log_scale.z);
}

// The plane of a splat in the camera frame. Its normal points towards the camera: it is the shortest axis times `sign`.
struct Plane {
    normal: vec3<f32>,
    // Distance of the plane from the camera centre, positive.
    distance: f32,
    sign: f32,
}

fn plane(g: Geometry, axis: u32) -> Plane {
    let column = select(select(g.u[2], g.u[1], axis == 1u), g.u[0], axis == 0u);
    let facing = dot(column, g.t);
    let sign = select(1.0, -1.0, facing >= 0.0);
    return Plane(column * sign, -(facing * sign), sign);
}
