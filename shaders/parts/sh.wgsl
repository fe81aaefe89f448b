// Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS.
// Needs: types; the binding `view`.

const SH_C0: f32 = 0.2820948;
const SH_C1: f32 = 0.48860252;
const SH_C2 = array<f32, 5>(1.0925485, -1.0925485, 0.31539157, -1.0925485, 0.5462742);
const SH_C3 = array<f32, 7>(-0.5900436, 2.8906114, -0.4570458, 0.37317634, -0.4570458, 1.4453057, -0.5900436);

// Unit direction from the camera to a splat, and 1 / distance.
fn view_direction(mean: vec3<f32>) -> vec4<f32> {
    let delta = mean - view.eye;
    let inv_length = 1.0 / sqrt(max(dot(delta, delta), 1e-20));
    return vec4(delta * inv_length, inv_length);
}

// Number of basis functions up to a degree.
fn sh_count(degree: u32) -> u32 {
    return (degree + 1u) * (degree + 1u);
}

// Values of all 16 basis functions for a unit direction. A lower degree uses only the first sh_count(degree) of them.
fn sh_basis(dir: vec3<f32>) -> array<f32, 16> {
    let x = dir.x;
    let y = dir.y;
    let z = dir.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    return array<f32, 16>(
        SH_C0,
        -SH_C1 * y,
        SH_C1 * z,
        -SH_C1 * x,
        SH_C2[0] * x * y,
        SH_C2[1] * y * z,
        SH_C2[2] * (zz + zz - xx - yy),
        SH_C2[3] * x * z,
        SH_C2[4] * (xx - yy),
        SH_C3[0] * y * (3.0 * xx - yy),
        SH_C3[1] * x * y * z,
        SH_C3[2] * y * (4.0 * zz - xx - yy),
        SH_C3[3] * z * (zz + zz - 3.0 * (xx + yy)),
        SH_C3[4] * x * (4.0 * zz - xx - yy),
        SH_C3[5] * z * (xx - yy),
        SH_C3[6] * x * (xx - 3.0 * yy),
    );
}
