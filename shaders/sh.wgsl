// Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS.

// Unit direction from the camera to a splat, and 1 / distance.
fn view_direction(mean: vec3<f32>) -> vec4<f32> {
    let delta = mean - view.eye;
    let inv_length = 1.0 / sqrt(max(dot(delta, delta), 1e-20));
    return vec4(delta * inv_length, inv_length);
}

fn sh_count(degree: u32) -> u32 {
    return (degree + 1u) * (degree + 1u);
}

// Values of the basis for a unit direction; only the first sh_count(degree) count.
fn sh_basis(dir: vec3<f32>) -> array<f32, 16> {
    let x = dir.x;
    let y = dir.y;
    let z = dir.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    return array<f32, 16>(
        0.2820948,
        -0.48860252 * y,
        0.48860252 * z,
        -0.48860252 * x,
        1.0925485 * x * y,
        -1.0925485 * y * z,
        0.31539157 * (zz + zz - xx - yy),
        -1.0925485 * x * z,
        0.5462742 * (xx - yy),
        -0.5900436 * y * (3.0 * xx - yy),
        2.8906114 * x * y * z,
        -0.4570458 * y * (4.0 * zz - xx - yy),
        0.37317634 * z * (zz + zz - 3.0 * (xx + yy)),
        -0.4570458 * x * (4.0 * zz - xx - yy),
        1.4453057 * z * (xx - yy),
        -0.5900436 * x * (xx - 3.0 * yy),
    );
}
