//! The frame in which a model is trained. It depends on the scene alone: its origin and axes follow from the cameras, and its
//! unit from the distance of the points from the cameras. So a scene trains to the same model in whatever coordinates it is
//! given.
//!
//! The smallest difference grows during a training: if one position differs in its last bit, the result may differ by 0.5 dB.
//! The same scene in UTM or in millimetres has such differences. So cameras and points are rounded in this frame, after which
//! they have the same bits in all coordinates, except for the rare value that lies half-way between two steps of the rounding.
//!
//! What it knows nothing about: files.

use cosurf_scene::{Camera, Pose, SparsePoint, Splats, camera, turn};
use glam::{DMat3, DQuat, DVec3};

/// The typical depth of a scene, units of the training. The renderer leaves out what is nearer than 0.2 units, which is 1/160
/// of this depth.
const DEPTH: f64 = 32.0;
/// Cameras' places, points and quaternions are rounded to multiples of these, units of the training. At 60 m above the ground,
/// that is 0.1 mm for cameras and 4 mm for points, far less than a pixel. Coordinates in UTM and ECEF are exact to a nanometre,
/// so two versions of a scene are rarely rounded differently.
const CAMERA_STEP: f64 = 1.0 / 16_384.0;
const POINT_STEP: f64 = 1.0 / 512.0;
const QUATERNION_STEP: f64 = 1.0 / 1_073_741_824.0;
/// Cameras that look in all directions have none in common: the length of the mean of their directions is below this.
const IN_COMMON_MIN: f64 = 0.1;
/// An axis of a camera is across a direction if the cosine of the angle between them is at most this.
const ACROSS_MAX: f64 = 0.8;

/// Cameras are almost in one place if the extent of their scene is at most this share of its depth.
const ONE_PLACE: f64 = 0.01;

/// Extent of the scene as 3DGS defines it, for cameras in the frame of the training. If all of them are almost in one place, it
/// is the typical depth, because the rates of learning follow from it.
pub(crate) fn extent(cameras: &[Camera]) -> f64 {
    let extent = camera::extent(cameras.iter());
    if extent > ONE_PLACE * DEPTH { extent } else { DEPTH }
}

/// A frame with `training = rotation · (given - origin) / unit`, where *given* is the frame of the scene that decides it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TrainingFrame {
    origin: DVec3,
    /// Length of the training's unit, positive.
    unit: f64,
    rotation: DQuat,
}

impl TrainingFrame {
    /// The frame of a scene with these cameras, at least one, and this typical depth, which must be positive.
    pub(crate) fn of(cameras: &[Camera], depth: f64) -> Self {
        let centers = cameras.iter().map(|camera| camera.cam_from_world.center());
        let origin = centers.sum::<DVec3>() / cameras.len() as f64;
        Self { origin, unit: depth / DEPTH, rotation: axes(cameras) }
    }

    /// Maps a camera into this frame, and rounds it.
    pub(crate) fn camera(&self, given: &Camera) -> Camera {
        let center = rounded(self.point(given.cam_from_world.center()), CAMERA_STEP);
        let turned = (given.cam_from_world.rotation * self.rotation.inverse()).normalize();
        let rotation = rounded_quaternion(turned);
        Camera { cam_from_world: Pose { rotation, translation: -(rotation * center) }, ..*given }
    }

    /// Maps a camera of this frame back.
    pub(crate) fn given_camera(&self, camera: &Camera) -> Camera {
        let pose = camera.cam_from_world;
        let center = self.origin + self.rotation.inverse() * pose.center() * self.unit;
        let rotation = (pose.rotation * self.rotation).normalize();
        Camera { cam_from_world: Pose { rotation, translation: -(rotation * center) }, ..*camera }
    }

    /// Maps points into this frame, and rounds them.
    pub(crate) fn move_points(&self, points: &mut [SparsePoint]) {
        points.iter_mut().for_each(|point| point.position = rounded(self.point(point.position), POINT_STEP));
    }

    /// Maps splats into this frame.
    pub(crate) fn move_splats(&self, splats: &mut Splats) {
        let origin = self.origin;
        splats.means.iter_mut().for_each(|mean| *mean = (to_f64(mean) - origin).as_vec3().to_array());
        turn::turn(splats, self.rotation);
        scale(splats, 1.0 / self.unit);
    }

    /// Maps splats of this frame back.
    pub(crate) fn move_splats_back(&self, splats: &mut Splats) {
        turn::turn(splats, self.rotation.inverse());
        scale(splats, self.unit);
        let origin = self.origin;
        splats.means.iter_mut().for_each(|mean| *mean = (to_f64(mean) + origin).as_vec3().to_array());
    }

    fn point(&self, given: DVec3) -> DVec3 {
        self.rotation * (given - self.origin) / self.unit
    }
}

/// Turns z into the direction in which the cameras look together, and x across it to the right of the first camera, or below
/// it. If they have no direction in common, z is where the first camera looks.
fn axes(cameras: &[Camera]) -> DQuat {
    let first = cameras[0].cam_from_world;
    let together =
        cameras.iter().map(|camera| camera.cam_from_world.forward()).sum::<DVec3>() / cameras.len() as f64;
    let z = if together.length() > IN_COMMON_MIN { together.normalize() } else { first.forward() };
    let [right, below] = [DVec3::X, DVec3::Y].map(|axis| first.rotation.inverse() * axis);
    let across = if right.dot(z).abs() <= ACROSS_MAX { right } else { below };
    let x = (across - z * across.dot(z)).normalize();
    DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize().inverse()
}

/// The nearest point of a lattice.
fn rounded(point: DVec3, step: f64) -> DVec3 {
    (point / step).round() * step
}

/// The nearest rotation of a lattice; of the two quaternions of a rotation, always the same.
fn rounded_quaternion(rotation: DQuat) -> DQuat {
    let steps = rotation.to_array().map(|value| (value / QUATERNION_STEP).round());
    let first = steps.into_iter().rev().find(|value| *value != 0.0).unwrap_or(1.0);
    DQuat::from_array(steps.map(|value| value * first.signum())).normalize()
}

fn scale(splats: &mut Splats, factor: f64) {
    splats.means.iter_mut().for_each(|mean| *mean = (to_f64(mean) * factor).as_vec3().to_array());
    let growth = libm::log(factor);
    let grown = |value: f32| (f64::from(value) + growth) as f32;
    splats.log_scales.iter_mut().for_each(|log_scale| *log_scale = log_scale.map(grown));
}

fn to_f64(mean: &[f32; 3]) -> DVec3 {
    DVec3::from_array(mean.map(f64::from))
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, Vec3};

    use super::*;

    /// `scale · rotation p + translation` for a scene.
    struct Elsewhere {
        scale: f64,
        rotation: DQuat,
        translation: DVec3,
    }

    const HERE: Elsewhere = Elsewhere { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    impl Elsewhere {
        fn point(&self, p: DVec3) -> DVec3 {
            self.scale * (self.rotation * p) + self.translation
        }

        fn camera(&self, camera: &Camera) -> Camera {
            let center = self.point(camera.cam_from_world.center());
            let rotation = (camera.cam_from_world.rotation * self.rotation.inverse()).normalize();
            Camera { cam_from_world: Pose { rotation, translation: -(rotation * center) }, ..*camera }
        }
    }

    fn elsewhere() -> [Elsewhere; 4] {
        let far = DVec3::new(4_164_871.0, 886_212.0, 4_731_102.0);
        [
            Elsewhere { translation: DVec3::new(500_123.4, 5_200_321.7, 400.1), ..HERE },
            Elsewhere { scale: 1e-4, ..HERE },
            Elsewhere { scale: 1e5, rotation: -DQuat::from_rotation_x(3.0), ..HERE },
            Elsewhere {
                rotation: DQuat::from_rotation_y(0.7) * DQuat::from_rotation_x(-1.0),
                translation: far,
                ..HERE
            },
        ]
    }

    fn camera(eye: DVec3, target: DVec3) -> Camera {
        Camera {
            cam_from_world: Pose::look_at(eye, target, DVec3::new(0.1, 1.0, 0.2)),
            focal_px: DVec2::splat(100.0),
            center_px: DVec2::splat(50.0),
            size_px: [100, 100],
        }
    }

    /// Cameras 60 m above a meadow, that look down at a slant.
    fn flight() -> Vec<Camera> {
        let eye =
            |i: u32| DVec3::new(13.7 * f64::from(i % 5), 11.3 * f64::from(i / 5), 60.0 + 0.3 * f64::from(i));
        (0..20).map(|i| camera(eye(i), eye(i) + DVec3::new(7.0, f64::from(i), -50.0))).collect()
    }

    fn meadow() -> Vec<SparsePoint> {
        let position = |i: u32| {
            let i = f64::from(i);
            DVec3::new((i * 1.37) % 71.0, (i * 0.73) % 53.0, libm::sin(i))
        };
        (0..2000).map(|i| SparsePoint { position: position(i), rgb: [0; 3], views: Vec::new() }).collect()
    }

    #[test]
    fn a_scene_has_the_same_bits_in_all_coordinates() {
        let mapped = |elsewhere: &Elsewhere| {
            let cameras: Vec<Camera> = flight().iter().map(|camera| elsewhere.camera(camera)).collect();
            let mut points = meadow();
            points.iter_mut().for_each(|point| point.position = elsewhere.point(point.position));
            let frame = TrainingFrame::of(&cameras, 60.0 * elsewhere.scale);
            frame.move_points(&mut points);
            (cameras.iter().map(|camera| frame.camera(camera)).collect::<Vec<_>>(), points)
        };
        let here = mapped(&HERE);
        for elsewhere in elsewhere() {
            assert!(mapped(&elsewhere) == here, "at {}", elsewhere.translation);
        }
        let nearly = mapped(&Elsewhere { scale: 1.0, rotation: DQuat::from_rotation_z(1e-5), ..HERE });
        assert!(nearly == here, "the whole scene is turned");
        let mut cameras = flight();
        cameras[3].cam_from_world.translation.x += 0.01;
        let frame = TrainingFrame::of(&cameras, 60.0);
        assert_ne!(frame.camera(&cameras[3]), here.0[3], "another scene");
    }

    #[test]
    fn cameras_points_and_splats_come_back() {
        let cameras = flight();
        let frame = TrainingFrame::of(&cameras, 60.0);
        for given in &cameras {
            let back = frame.given_camera(&frame.camera(given)).cam_from_world;
            assert!(back.center().distance(given.cam_from_world.center()) < 1e-4);
            assert!(back.rotation.angle_between(given.cam_from_world.rotation) < 1e-7);
        }
        let mut splats = Splats::with_capacity(1, 1);
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|k| k as f32 * 0.1).collect();
        splats.push([40.0, 20.0, 3.0], [0.9, 0.1, -0.3, 0.2], [-1.0, -2.0, -3.0], 0.5, &sh);
        let given = splats.clone();
        frame.move_splats(&mut splats);
        // What a camera sees of a splat has not changed.
        let [was, is] = [&given, &splats].map(|splats| to_f64(&splats.means[0]));
        let [a, b] =
            [cameras[7].project(was), frame.camera(&cameras[7]).project(is)].map(Option::unwrap_or_default);
        assert!(a != DVec2::ZERO && a.distance(b) < 1e-3, "{a} {b}");
        frame.move_splats_back(&mut splats);
        let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        assert!(near(&splats.means[0], &given.means[0]), "{:?}", splats.means[0]);
        assert!(near(&splats.quats[0], &given.quats[0]) && near(&splats.sh, &given.sh));
        assert!(near(&splats.log_scales[0], &given.log_scales[0]));
        assert_eq!(Vec3::from(given.log_scales[0]), Vec3::new(-1.0, -2.0, -3.0));
    }

    #[test]
    fn cameras_may_be_in_one_place_and_look_all_around() {
        let around = |i: u32| {
            let (sin, cos) = libm::sincos(f64::from(i));
            camera(DVec3::ZERO, DVec3::new(sin, 0.01 * f64::from(i) - 0.2, cos))
        };
        let cameras: Vec<Camera> = (0..40).map(around).collect();
        let frame = TrainingFrame::of(&cameras, 64.0);
        assert_eq!(frame.unit, 2.0);
        // A panorama far from the origin, whose centres differ by rounding.
        let far = Elsewhere { translation: DVec3::new(0.1, -70.3, 60.7), ..HERE };
        let shifted: Vec<Camera> = cameras.iter().map(|camera| far.camera(camera)).collect();
        assert_eq!(extent(&shifted), DEPTH);
        assert!(extent(&flight()) > DEPTH);
        let z = frame.rotation * cameras[0].cam_from_world.forward();
        assert!(z.distance(DVec3::Z) < 1e-9, "{z}");
        // A camera whose x axis is where all look together.
        let mut cameras = vec![camera(DVec3::ZERO, DVec3::X); 9];
        cameras.insert(0, camera(DVec3::ZERO, DVec3::Z));
        let frame = TrainingFrame::of(&cameras, 64.0);
        assert!((frame.rotation.length() - 1.0).abs() < 1e-12);
    }
}
