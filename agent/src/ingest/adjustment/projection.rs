//! Where a photograph shows a point, and how that changes with the pose, the lens and the point.

use glam::{DQuat, DVec2, DVec3};

use super::super::lens::Lens;

/// Unknowns of a pose: a rotation vector in the camera's frame, radians, then the camera's position, metres.
pub(super) const POSE: usize = 6;
/// Unknowns of a lens, as [`Lens::parameters`].
pub(super) const LENS: usize = 8;

/// A pose: `rotation` takes directions of the world to those of the camera, which is at `center`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Station {
    pub(super) rotation: DQuat,
    pub(super) center: DVec3,
}

impl Station {
    /// The pose after a step of its unknowns.
    pub(super) fn stepped(&self, step: &[f64]) -> Self {
        let rotation = DQuat::from_scaled_axis(DVec3::from_slice(step)) * self.rotation;
        Self { rotation: rotation.normalize(), center: self.center + DVec3::from_slice(&step[3..]) }
    }
}

/// Derivatives of a position in a picture: for x and for y.
pub(super) struct Derivatives {
    /// By the unknowns of the pose, then by those of the lens.
    pub(super) unknowns: [[f64; POSE + LENS]; 2],
    pub(super) point: [DVec3; 2],
}

/// Where a photograph shows a point; `None` if the point is not in front of the camera.
pub(super) fn project(station: &Station, lens: &Lens, point: DVec3) -> Option<DVec2> {
    let p = station.rotation * (point - station.center);
    (p.z > 0.0).then(|| lens.distort(p.truncate() / p.z).0 * lens.focal_px + lens.center_px)
}

/// As [`project`], with derivatives.
pub(super) fn differentiate(station: &Station, lens: &Lens, point: DVec3) -> Option<(DVec2, Derivatives)> {
    let p = station.rotation * (point - station.center);
    if p.z <= 0.0 {
        return None;
    }
    let ray = p.truncate() / p.z;
    let (bent, slope) = lens.distort(ray);
    let back = station.rotation.inverse();
    let DVec2 { x, y } = ray;
    let r2 = ray.length_squared();
    let mut its = Derivatives { unknowns: [[0.0; POSE + LENS]; 2], point: [DVec3::ZERO; 2] };
    for axis in 0..2 {
        let focal = lens.focal_px[axis];
        let along = DVec2::new(slope.x_axis[axis], slope.y_axis[axis]) * (focal / p.z);
        let over_p = along.extend(-along.dot(ray));
        its.point[axis] = back * over_p;
        let turn = p.cross(over_p);
        let unknowns = &mut its.unknowns[axis];
        unknowns[..3].copy_from_slice(&turn.to_array());
        unknowns[3..POSE].copy_from_slice(&(-its.point[axis]).to_array());
        let over_lens = &mut unknowns[POSE..];
        over_lens[axis] = bent[axis];
        over_lens[2 + axis] = 1.0;
        over_lens[4] = focal * ray[axis] * r2;
        over_lens[5] = focal * ray[axis] * r2 * r2;
        over_lens[6] = focal * [2.0 * x * y, r2 + 2.0 * y * y][axis];
        over_lens[7] = focal * [r2 + 2.0 * x * x, 2.0 * x * y][axis];
    }
    Some((bent * lens.focal_px + lens.center_px, its))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A step of a difference; the truncation and the rounding of central differences are then below 1e-6.
    const STEP: f64 = 1e-6;

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let station = Station {
            rotation: DQuat::from_xyzw(0.9, 0.1, -0.2, 0.1).normalize(),
            center: DVec3::new(12.0, -7.0, 60.0),
        };
        let lens = Lens {
            size_px: [800, 600],
            focal_px: DVec2::new(690.0, 700.0),
            center_px: DVec2::new(415.0, 286.0),
            distortion: [-0.06, 0.02, 0.003, -0.004],
        };
        let point = DVec3::new(20.0, 5.0, 2.0);
        let (at_px, derivatives) = differentiate(&station, &lens, point).unwrap();
        assert_eq!(project(&station, &lens, point), Some(at_px));
        let check = |name: &str, found: [f64; 2], seen: &dyn Fn(f64) -> DVec2| {
            let difference = (seen(STEP) - seen(-STEP)) / (2.0 * STEP);
            for axis in 0..2 {
                let off = (difference[axis] - found[axis]).abs();
                assert!(off < 1e-4 * (1.0 + found[axis].abs()), "{name}: {difference} {found:?}");
            }
        };
        for i in 0..POSE + LENS {
            check(&format!("unknown {i}"), derivatives.unknowns.map(|row| row[i]), &|by| {
                let mut step = [0.0; POSE + LENS];
                step[i] = by;
                let mut parameters = lens.parameters();
                parameters.iter_mut().zip(&step[POSE..]).for_each(|(its, step)| *its += step);
                let lens = Lens::of_parameters(lens.size_px, parameters).unwrap();
                project(&station.stepped(&step), &lens, point).unwrap()
            });
        }
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            check("point", derivatives.point.map(|row| row.dot(axis)), &|by| {
                project(&station, &lens, point + by * axis).unwrap()
            });
        }
        assert!(differentiate(&station, &lens, DVec3::new(0.0, 0.0, 200.0)).is_none());
    }
}
