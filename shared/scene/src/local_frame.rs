//! The frame of the numbers that are computed with: near the scene, and of an ordinary size.
//!
//! Positions of splats and vertices are `f32`. In UTM or ECEF, an `f32` is half a metre, and a scene of another unit
//! than metres may be a thousandth or a thousand times as large as renderer and optimiser expect. So a scene that lies
//! far away or is very small or large is moved, when it is read, into a *local frame*: `world = origin + unit · local`,
//! in `f64`. What is written is in the world again: cameras as `f64`, positions relative to the origin, which is
//! written beside them.

use glam::DVec3;

use crate::camera::extent;
use crate::{Camera, Pose, Splats};

/// Limit on the absolute value of each coordinate of an origin, world units: more than the size of the earth.
pub const ORIGIN_MAX: f64 = 1e8;
/// Largest magnitude of a log scale and of a coordinate after a move: what a damaged file claims stays a number that can
/// be rendered.
const LOG_SCALE_MOST: f32 = 39.0;
/// See [`LOG_SCALE_MOST`].
const POSITION_MOST: f64 = 1e22;
/// A scene is moved if it lies farther from the world's origin than so many of its extents. At 32, an `f32` is still exact
/// to two millionths of the extent.
const NEAR_EXTENTS: f64 = 32.0;
/// Origins are multiples of the smallest power of ten that has so many extents, so that the models of neighbours mostly
/// have the same origin, and people can read it.
const LATTICE_EXTENTS: f64 = 4.0;
/// A scene of such an extent is not scaled.
const ORDINARY: std::ops::RangeInclusive<f64> = 0.5..=16_384.0;
/// Any other is scaled to this extent or up to twice as much.
const EXTENT: f64 = 64.0;
/// Sizes of real scenes, world units, from a crystal's to a planet's; what lies beyond is damage.
pub const SCENE_SIZES: std::ops::RangeInclusive<f64> = 1e-9..=1e12;

/// A frame whose axes are those of the world: `world = origin + unit · local`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalFrame {
    origin: DVec3,
    /// The unit is 2 to this power, so that scaling is exact.
    unit_exponent: i32,
}

impl LocalFrame {
    /// The world's own frame.
    pub const WORLD: Self = Self { origin: DVec3::ZERO, unit_exponent: 0 };

    /// The frame with an origin, world units, and the world's unit.
    pub fn at(origin: DVec3) -> Self {
        Self { origin, unit_exponent: 0 }
    }

    /// A frame in which the scene of these world cameras is near the origin and of an ordinary size. It is the world's
    /// frame where that is so already, and where the cameras do not tell: none, one, or all in one place.
    pub fn of<'a>(cameras: impl Iterator<Item = &'a Camera> + Clone) -> Self {
        let extent = extent(cameras.clone());
        let centers = cameras.map(|camera| camera.cam_from_world.center());
        let center = centers.clone().sum::<DVec3>() / centers.count().max(1) as f64;
        // Distances in ECEF are exact to a nanometre; a smaller extent is rounding.
        let is_told = SCENE_SIZES.contains(&extent) && extent > 1e-12 * center.abs().max_element();
        if !is_told {
            return Self::WORLD;
        }
        let origin = match center.abs().max_element() > NEAR_EXTENTS * extent {
            true => {
                let step = 10f64.powi(libm::log10(LATTICE_EXTENTS * extent).ceil() as i32);
                (center / step).round() * step
            }
            false => DVec3::ZERO,
        };
        let unit_exponent =
            if ORDINARY.contains(&extent) { 0 } else { libm::log2(extent / EXTENT).floor() as i32 };
        Self { origin, unit_exponent }
    }

    /// The frame that most of these are, the first of several; the world's if there are none. So a few odd models of a
    /// site do not decide where the rest is exact.
    pub fn most_common(frames: &[Self]) -> Self {
        let count = |frame: &Self| frames.iter().filter(|other| *other == frame).count();
        let first_of_most =
            frames.iter().reduce(|best, frame| if count(frame) > count(best) { frame } else { best });
        first_of_most.copied().unwrap_or(Self::WORLD)
    }

    /// The origin, world units.
    pub fn origin(&self) -> DVec3 {
        self.origin
    }

    /// Length of the local unit, world units.
    pub fn unit(&self) -> f64 {
        libm::exp2(f64::from(self.unit_exponent))
    }

    /// The frame with the same origin and the world's unit: the frame of files.
    pub fn of_files(&self) -> Self {
        Self::at(self.origin)
    }

    /// Maps a world point into this frame.
    pub fn local_from_world(&self, point: DVec3) -> DVec3 {
        (point - self.origin) / self.unit()
    }

    /// Maps a point of this frame into the world.
    pub fn world_from_local(&self, point: DVec3) -> DVec3 {
        self.origin + point * self.unit()
    }

    /// Maps the pose of a world camera into this frame.
    pub fn local_camera(&self, camera: &Camera) -> Camera {
        let Pose { rotation, translation } = camera.cam_from_world;
        self.with_translation(camera, (translation + rotation * self.origin) / self.unit())
    }

    /// Maps the pose of a camera of this frame into the world.
    pub fn world_camera(&self, camera: &Camera) -> Camera {
        let Pose { rotation, translation } = camera.cam_from_world;
        self.with_translation(camera, translation * self.unit() - rotation * self.origin)
    }

    /// In the world's frame, a camera keeps its bits.
    fn with_translation(&self, camera: &Camera, translation: DVec3) -> Camera {
        if *self == Self::WORLD {
            return *camera;
        }
        Camera { cam_from_world: Pose { translation, ..camera.cam_from_world }, ..*camera }
    }

    /// Maps splats of this frame into another one. In the same frame, they keep their bits.
    pub fn move_splats(&self, splats: &mut Splats, to: &Self) {
        if self == to {
            return;
        }
        splats.means.iter_mut().for_each(|mean| *mean = self.moved(*mean, to));
        splats.log_scales.iter_mut().for_each(|log_scale| *log_scale = self.moved_log_scale(*log_scale, to));
    }

    /// Maps the log scales of a splat of this frame into another one.
    pub fn moved_log_scale(&self, log_scale: [f32; 3], to: &Self) -> [f32; 3] {
        if self.unit_exponent == to.unit_exponent {
            return log_scale;
        }
        let growth = ((self.unit_exponent - to.unit_exponent) as f32) * std::f32::consts::LN_2;
        log_scale.map(|value| (value + growth).clamp(-LOG_SCALE_MOST, LOG_SCALE_MOST))
    }

    /// Maps a position of this frame into another one. In the same frame, it keeps its bits.
    pub fn moved(&self, position: [f32; 3], to: &Self) -> [f32; 3] {
        if self == to {
            return position;
        }
        // The difference of the origins comes first: both may be large, and the position is small.
        let (shift, scale) = ((self.origin - to.origin) / to.unit(), self.unit() / to.unit());
        let moved = shift + DVec3::from_array(position.map(f64::from)) * scale;
        moved.clamp(DVec3::splat(-POSITION_MOST), DVec3::splat(POSITION_MOST)).as_vec3().to_array()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec2};

    /// Cameras at the corners of a square of such a half side about a point.
    fn square(center: DVec3, half_side: f64) -> Vec<Camera> {
        let corners = [[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]];
        let camera = |[x, y]: [f64; 2]| {
            let rotation = DQuat::from_euler(glam::EulerRot::ZYX, x, y, 0.3);
            let eye = center + DVec3::new(x, y, 0.0) * half_side;
            Camera {
                cam_from_world: Pose { rotation, translation: -(rotation * eye) },
                focal_px: DVec2::splat(100.0),
                center_px: DVec2::splat(50.0),
                size_px: [100, 100],
            }
        };
        corners.map(camera).to_vec()
    }

    fn of(center: [f64; 3], half_side: f64) -> LocalFrame {
        LocalFrame::of(square(DVec3::from_array(center), half_side).iter())
    }

    #[test]
    fn ordinary_scenes_stay_in_the_world() {
        assert_eq!(of([0.0, 0.0, 60.0], 100.0), LocalFrame::WORLD);
        assert_eq!(of([2000.0, -900.0, 400.0], 100.0), LocalFrame::WORLD);
        assert_eq!(of([5e5, 5e6, 400.0], 0.0), LocalFrame::WORLD, "one place does not tell the size");
        assert_eq!(of([0.0; 3], 1e-200), LocalFrame::WORLD, "no scene is so small");
        assert_eq!(of([0.0; 3], 1e200), LocalFrame::WORLD, "or so large");
        assert_eq!(LocalFrame::of([].iter()), LocalFrame::WORLD);
    }

    #[test]
    fn far_scenes_get_a_round_origin_that_neighbours_share() {
        let utm = of([500_123.0, 5_200_321.0, 400.0], 100.0);
        assert_eq!(utm, LocalFrame::at(DVec3::new(500_000.0, 5_200_000.0, 0.0)));
        assert_eq!(of([500_323.0, 5_199_921.0, 380.0], 90.0), utm);
        assert_eq!(of([4_164_871.0, 886_212.0, 4_731_102.0], 100.0).origin().z, 4_731_000.0, "ECEF");
    }

    #[test]
    fn most_models_of_a_site_decide_its_frame() {
        let [a, b] = [1.0, 2.0].map(|x| LocalFrame::at(DVec3::X * x));
        assert_eq!(LocalFrame::most_common(&[a, b, b]), b);
        assert_eq!(LocalFrame::most_common(&[b, a, a, b]), b, "of equally many, the first");
        assert_eq!(LocalFrame::most_common(&[]), LocalFrame::WORLD);
    }

    #[test]
    fn tiny_and_huge_scenes_are_scaled_to_an_ordinary_size() {
        for exponent in [-4, -3, 3, 5, 9] {
            let scale = 10f64.powi(exponent);
            let frame = of([0.0, 0.0, 60.0 * scale], 100.0 * scale);
            let extent = extent(square(DVec3::ZERO, 100.0 * scale).iter()) / frame.unit();
            assert!((EXTENT..2.0 * EXTENT).contains(&extent), "{scale}: {extent}");
            assert_eq!(frame.origin(), DVec3::ZERO);
        }
    }

    #[test]
    fn cameras_and_splats_survive_the_way_there_and_back() {
        for frame in
            [of([500_123.0, 5_200_321.0, 400.0], 100.0), of([3e-3, 0.0, 0.0], 1e-4), LocalFrame::WORLD]
        {
            let eye = frame.world_from_local(DVec3::new(3.0, 4.0, 5.0));
            let camera = square(eye, 0.0)[1];
            let local = frame.local_camera(&camera);
            assert!(local.cam_from_world.center().distance(DVec3::new(3.0, 4.0, 5.0)) < 1e-6, "{local:?}");
            let back = frame.world_camera(&local);
            assert!(back.cam_from_world.center().distance(eye) < 1e-8);
            let mut splats = Splats::with_capacity(1, 0);
            splats.push([1.5, -2.25, 8.0], [1.0, 0.0, 0.0, 0.0], [-3.0; 3], 0.0, &[0.0; 3]);
            let (before, to) = (splats.clone(), LocalFrame::at(frame.origin() + DVec3::X * 1000.0));
            frame.move_splats(&mut splats, &to);
            let world = to.world_from_local(DVec3::from_array(splats.means[0].map(f64::from)));
            let expected = frame.world_from_local(DVec3::new(1.5, -2.25, 8.0));
            assert!(world.distance(expected) < 1e-4, "{world} for {expected}");
            let scale = splats.log_scales[0][0].exp() / before.log_scales[0][0].exp();
            assert!((f64::from(scale) - frame.unit()).abs() < 1e-6 * frame.unit());
            frame.move_splats(&mut splats, &frame);
        }
    }
}
