//! Which direction of a reconstruction is up, from how its cameras hung and how the ground lies.

use glam::{DMat3, DVec3};

use super::observation::median;

/// Cameras whose median angle from straight down is below this are taken to look down, degrees.
const NADIR_DEG: f64 = 30.0;
/// Directions farther apart than so many standard deviations contradict each other.
const CONTRADICTION: f64 = 3.0;
/// Least standard deviation of up by cameras, however many, degrees: gimbals and mounts are off.
const MOUNT_DEG: f64 = 2.0;
/// The same for cameras that all head one way, degrees: then they may as well look ahead.
const ONE_HEADING_DEG: f64 = 15.0;
/// Cameras head more than one way if the mean of their x axes is shorter than this.
const HEADINGS_MEAN: f64 = 0.7;
/// Standard deviation of the ground's slope, degrees: hills.
const SLOPE_DEG: f64 = 5.0;
/// The cameras' headings must differ, so that their horizons tell up: the least share of the middle eigenvalue.
const HEADINGS_SHARE: f64 = 0.05;
/// Rounds in which points off the ground lose their weight.
const ROUNDS: usize = 20;
/// Points farther from the middle than this share of all are the horizon's, not the ground's.
const NEAR_SHARE: f64 = 0.8;

/// The direction of up in a reconstruction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Up {
    /// Unit length.
    pub direction: DVec3,
    /// Its standard deviation in each of two directions, radians.
    pub sigma_rad: f64,
}

impl Up {
    /// From the cameras: the opposite of where they look if they look down, or the direction that all their horizons share,
    /// whichever is more certain; and from the normal of the ground's plane. Both count by their certainty if they do not
    /// contradict each other, else the more certain one. `forward` and `right` are unit directions of each camera, `points` are those of the
    /// ground. `None` without cameras.
    pub fn of(forward: &[DVec3], right: &[DVec3], points: &[DVec3]) -> Option<Self> {
        let upright = upright(forward, right)?;
        let surer = |a: Self, b: Self| if b.sigma_rad < a.sigma_rad { b } else { a };
        let cameras = [nadir(forward, right), horizon(right, upright)].into_iter().flatten().reduce(surer);
        let found =
            cameras.into_iter().chain(plane(points, upright)).reduce(|a, b| a.with(b).unwrap_or(surer(a, b)));
        Some(found.unwrap_or(Self { direction: upright, sigma_rad: NADIR_DEG.to_radians() }))
    }

    /// The mean of two directions by their certainty; `None` if they contradict each other.
    fn with(self, other: Self) -> Option<Self> {
        let apart = self.direction.angle_between(other.direction);
        let [a, b] = [self, other].map(|its| its.sigma_rad.powi(-2));
        let agrees = apart <= CONTRADICTION * self.sigma_rad.hypot(other.sigma_rad);
        let direction = (self.direction * a + other.direction * b).try_normalize()?;
        agrees.then(|| Self { direction, sigma_rad: (a + b).sqrt().recip() })
    }
}

/// Roughly up: where pictures of cameras that look ahead have it, and away from where cameras that look down look.
fn upright(forward: &[DVec3], right: &[DVec3]) -> Option<DVec3> {
    let sum =
        forward.iter().zip(right).map(|(forward, right)| right.cross(*forward) - *forward).sum::<DVec3>();
    let down = -forward.iter().sum::<DVec3>();
    // The pictures' tops cancel each other if cameras look down and fly to and fro.
    sum.try_normalize().or_else(|| down.try_normalize())
}

fn nadir(forward: &[DVec3], right: &[DVec3]) -> Option<Up> {
    let direction = (-forward.iter().sum::<DVec3>()).try_normalize()?;
    let angles = || forward.iter().map(|forward| (-*forward).angle_between(direction));
    if median(angles().collect()) > NADIR_DEG.to_radians() {
        return None;
    }
    let one_heading = right.iter().sum::<DVec3>().length() > HEADINGS_MEAN * right.len() as f64;
    let mount_deg = if one_heading { ONE_HEADING_DEG } else { MOUNT_DEG };
    // Wind makes a camera without a gimbal lean one way for a whole flight, so that many are no better than one.
    let spread_rad = (angles().map(|angle| angle * angle).sum::<f64>() / 2.0 / forward.len() as f64).sqrt();
    Some(Up { direction, sigma_rad: mount_deg.to_radians().hypot(spread_rad) })
}

/// The direction that is closest to a right angle with each camera's x axis.
fn horizon(right: &[DVec3], upright: DVec3) -> Option<Up> {
    let sum = right.iter().fold(DMat3::ZERO, |sum, x| sum + DMat3::from_cols(*x * x.x, *x * x.y, *x * x.z));
    let mean = sum * (1.0 / right.len() as f64);
    // The eigenvector of the smallest eigenvalue, by inverse iteration; the shift keeps the inverse finite.
    let inverse = (mean + DMat3::IDENTITY * 1e-9).inverse();
    let mut direction = upright;
    for _ in 0..100 {
        direction = (inverse * direction).try_normalize()?;
    }
    let least = direction.dot(mean * direction).max(0.0);
    // The eigenvalues add up to 1; the product of the upper two follows from the second invariant.
    let (sum, product) = (1.0 - least, second_invariant(&mean) - least * (1.0 - least));
    let middle = sum / 2.0 - (sum * sum / 4.0 - product).max(0.0).sqrt();
    if middle < HEADINGS_SHARE {
        return None;
    }
    let roll_rad = (least / middle).sqrt();
    let direction = if direction.dot(upright) < 0.0 { -direction } else { direction };
    Some(Up { direction, sigma_rad: MOUNT_DEG.to_radians().hypot(roll_rad) })
}

/// The sum of the products of each two eigenvalues of a symmetric matrix.
fn second_invariant(m: &DMat3) -> f64 {
    let square = *m * *m;
    let trace = |m: &DMat3| m.x_axis.x + m.y_axis.y + m.z_axis.z;
    (trace(m).powi(2) - trace(&square)) / 2.0
}

/// The normal of the plane through most points.
fn plane(points: &[DVec3], upright: DVec3) -> Option<Up> {
    let middle = DVec3::from([0, 1, 2].map(|axis| median(points.iter().map(|p| p[axis]).collect())));
    let (u, v) = upright.any_orthonormal_pair();
    let local = |p: &DVec3| DVec3::new(u.dot(*p - middle), v.dot(*p - middle), upright.dot(*p - middle));
    let mut local: Vec<DVec3> = points.iter().map(local).collect();
    local.sort_by(|a, b| a.truncate().length_squared().total_cmp(&b.truncate().length_squared()));
    local.truncate((local.len() as f64 * NEAR_SHARE) as usize);
    let extent = local.last()?.truncate().length();
    // Heights are `slope.x * x + slope.y * y + slope.z`.
    let height = |slope: DVec3, p: &DVec3| slope.dot(p.truncate().extend(1.0));
    let (mut slope, mut rough) = (DVec3::ZERO, f64::INFINITY);
    for _ in 0..ROUNDS {
        let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for p in &local {
            let row = p.truncate().extend(1.0);
            let weight = (1.0 + ((p.z - height(slope, p)) / rough).powi(2)).powi(-2);
            matrix += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
            right += row * (weight * p.z);
        }
        slope = matrix.inverse() * right;
        rough = 3.0 * median(local.iter().map(|p| (p.z - height(slope, p)).abs()).collect());
        // Perfectly flat ground: no weights, which would be divisions by zero.
        rough = if rough > 0.0 { rough } else { f64::INFINITY };
    }
    let direction =
        (upright - u * slope.x - v * slope.y).try_normalize().filter(|direction| direction.is_finite())?;
    let rough_rad = if rough.is_finite() { (rough / extent).atan() } else { 0.0 };
    Some(Up { direction, sigma_rad: SLOPE_DEG.to_radians().hypot(rough_rad) })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Directions of cameras with a heading, a tilt from straight down, and a roll, degrees; z is up.
    fn camera([heading, tilt, roll]: [f64; 3]) -> (DVec3, DVec3) {
        use glam::DQuat;
        let turn = DQuat::from_rotation_z(heading.to_radians())
            * DQuat::from_rotation_x(tilt.to_radians())
            * DQuat::from_rotation_y(roll.to_radians());
        (turn * -DVec3::Z, turn * DVec3::X)
    }

    fn up_of(cameras: &[[f64; 3]], points: &[DVec3]) -> Up {
        let (forward, right): (Vec<_>, Vec<_>) = cameras.iter().map(|camera_| camera(*camera_)).unzip();
        Up::of(&forward, &right, points).unwrap()
    }

    fn off_deg(up: &Up) -> f64 {
        up.direction.angle_between(DVec3::Z).to_degrees()
    }

    #[test]
    fn cameras_that_look_down_to_and_fro_tell_up() {
        let cameras: Vec<_> = (0..40)
            .map(|i| [f64::from(i % 2) * 180.0, 5.0 + f64::from(i * 7 % 5), f64::from(i * 5 % 7) - 3.0])
            .collect();
        let up = up_of(&cameras, &[]);
        assert!(off_deg(&up) < 1.0, "{}", off_deg(&up));
        assert!((4.0..7.0).contains(&up.sigma_rad.to_degrees()), "{up:?}");
    }

    #[test]
    fn horizons_of_oblique_cameras_tell_up() {
        let cameras: Vec<_> =
            (0..24).map(|i| [f64::from(i) * 15.0, 60.0, f64::from(i * 5 % 7) - 3.0]).collect();
        let up = up_of(&cameras, &[]);
        assert!(off_deg(&up) < 1.5, "{}", off_deg(&up));
        assert!((2.0..5.0).contains(&up.sigma_rad.to_degrees()), "{up:?}");
    }

    #[test]
    fn cameras_that_wind_tilts_and_flat_ground_share_the_error() {
        let lean = DVec3::new(0.1, 0.0, -1.0).normalize();
        let headings =
            [[1.0, 0.0], [-1.0, 0.0]].map(|[x, y]| (DVec3::new(x, y, 0.0) - lean * lean.x * x).normalize());
        let wobble = |i: usize| (lean + DVec3::new(0.0, 0.07 * (i % 5) as f64 - 0.14, 0.0)).normalize();
        let (forward, right): (Vec<_>, Vec<_>) = (0..40).map(|i| (wobble(i), headings[i % 2])).unzip();
        let points: Vec<DVec3> =
            (0..400).map(|i| DVec3::new(f64::from(i % 20), f64::from(i / 20), 0.0)).collect();
        let up = Up::of(&forward, &right, &points).unwrap();
        assert!((0.5..4.0).contains(&off_deg(&up)), "of 5.7 degrees: {}", off_deg(&up));
        let tall = points.iter().map(|p| DVec3::new(p.x, p.z, p.y)).collect::<Vec<_>>();
        let contradicted = Up::of(&forward, &right, &tall).unwrap();
        assert!((5.0..6.5).contains(&off_deg(&contradicted)), "{}", off_deg(&contradicted));
    }

    #[test]
    fn the_ground_tells_up_where_all_cameras_look_one_way() {
        let cameras = [[10.0, 60.0, 0.0]; 9];
        // A tenth of the points are trees.
        let points: Vec<DVec3> = (0..400)
            .map(|i| {
                DVec3::new(
                    f64::from(i % 20),
                    f64::from(i / 20),
                    if i % 10 == 0 { 4.0 } else { 0.01 * f64::from(i % 3) },
                )
            })
            .collect();
        let up = up_of(&cameras, &points);
        assert!(off_deg(&up) < 0.5, "{}", off_deg(&up));
        assert!(up.sigma_rad.to_degrees() > 4.9, "{up:?}");
        let nothing = up_of(&cameras, &[]);
        assert!(nothing.sigma_rad.to_degrees() > 14.0, "{nothing:?}");
    }
}
