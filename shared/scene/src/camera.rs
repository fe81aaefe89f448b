//! Cameras: the pose of a picture, and the mapping between its pixels and viewing rays.
//!
//! World frame: any right-handed metric frame (the drone scenes use east, north, up). Camera frame: x right, y
//! down, z forward. Pixel `(i, j)` covers `[i, i+1) × [j, j+1)`; its centre is `(i + 0.5, j + 0.5)`. A point `p`
//! of the camera frame is projected to `focal_px * p.xy / p.z + center_px` (COLMAP's `PINHOLE`).

use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Cameras with almost the same view are at most this share of the depth apart.
const ALIKE_SHARE: f64 = 0.01;
/// Cosine of half of the largest angle, half a degree, between the rotations of cameras with almost the same view.
const ALIKE_HALF_COSINE: f64 = 0.999_990_480_720_734_3;

/// A rigid transform from the world frame to a camera frame: `p_cam = rotation * p_world + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// World units (metres).
    pub translation: DVec3,
}

impl Pose {
    /// The camera centre in the world frame: `-Rᵀ t`, where `R` is the rotation and `t` the translation.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.inverse() * self.translation)
    }

    /// Maps a world point into the camera frame.
    pub fn transform(&self, p_world: DVec3) -> DVec3 {
        self.rotation * p_world + self.translation
    }

    /// The bits of all values. They serve as a key, because floating-point values have no total order.
    pub fn bits(&self) -> [u64; 7] {
        let [qx, qy, qz, qw] = self.rotation.to_array().map(f64::to_bits);
        let [tx, ty, tz] = self.translation.to_array().map(f64::to_bits);
        [qx, qy, qz, qw, tx, ty, tz]
    }

    /// The direction in which the camera looks, in the world frame, unit length.
    pub fn forward(&self) -> DVec3 {
        self.rotation.inverse() * DVec3::Z
    }

    /// The pose of a camera at the world position `eye` that looks at the world position `target`. The world
    /// direction `up` appears upright in the picture; it must not be parallel to the line of sight.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3) -> Self {
        let z = (target - eye).normalize();
        let x = z.cross(up).normalize();
        let y = z.cross(x);
        let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, z).transpose()).normalize();
        Self { rotation, translation: -(rotation * eye) }
    }
}

/// A pinhole camera. Its principal point need not be the centre of the picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Maps world points into this camera's frame.
    pub cam_from_world: Pose,
    /// Focal lengths in x and y, pixels, finite and positive.
    pub focal_px: DVec2,
    /// Principal point in pixels, measured from the picture's top-left corner.
    pub center_px: DVec2,
    /// Width and height in pixels, each at least 1.
    pub size_px: [u32; 2],
}

impl Camera {
    /// Projects a world point to pixels; `None` if the point is not in front of the camera.
    pub fn project(&self, p_world: DVec3) -> Option<DVec2> {
        self.project_with_depth(p_world).map(|(p_px, _)| p_px)
    }

    /// As [`Self::project`], with the depth of the point along the optical axis, world units.
    pub fn project_with_depth(&self, p_world: DVec3) -> Option<(DVec2, f64)> {
        let p = self.cam_from_world.transform(p_world);
        (p.z > 0.0).then(|| (self.focal_px * p.truncate() / p.z + self.center_px, p.z))
    }

    /// The viewing ray through a pixel position, in the camera frame, scaled to `z = 1`.
    pub fn ray(&self, p_px: DVec2) -> DVec3 {
        ((p_px - self.center_px) / self.focal_px).extend(1.0)
    }

    /// The world point at a pixel position and at a depth along the optical axis (world units); the inverse of
    /// [`Self::project`].
    pub fn unproject(&self, p_px: DVec2, depth: f64) -> DVec3 {
        let pose = &self.cam_from_world;
        pose.rotation.inverse() * (self.ray(p_px) * depth - pose.translation)
    }

    /// Whether a pixel position lies inside the picture.
    pub fn contains(&self, p_px: DVec2) -> bool {
        p_px.x >= 0.0
            && p_px.y >= 0.0
            && p_px.x < f64::from(self.size_px[0])
            && p_px.y < f64::from(self.size_px[1])
    }

    /// Whether a world point lies in front of the camera and inside its picture.
    pub fn sees(&self, p_world: DVec3) -> bool {
        self.project(p_world).is_some_and(|p_px| self.contains(p_px))
    }

    /// Whether another camera has almost the same view of what lies at a depth: the centres are at most a hundredth of
    /// the depth apart, and their rotations differ by at most half a degree. The size of the picture does not matter.
    pub fn views_alike(&self, other: &Self, depth: f64) -> bool {
        let [a, b] = [self, other].map(|camera| camera.cam_from_world);
        a.center().distance(b.center()) <= ALIKE_SHARE * depth
            && a.rotation.dot(b.rotation).abs() >= ALIKE_HALF_COSINE
    }

    /// The same camera for a picture resampled to `size_px`: each axis of the intrinsics scales by
    /// the ratio of the new size to the old.
    pub fn resized(&self, size_px: [u32; 2]) -> Self {
        let ratio = DVec2::new(
            f64::from(size_px[0]) / f64::from(self.size_px[0]),
            f64::from(size_px[1]) / f64::from(self.size_px[1]),
        );
        Self { focal_px: self.focal_px * ratio, center_px: self.center_px * ratio, size_px, ..*self }
    }

    /// This camera with a picture shrunk by [`fitted_size`] if its long side exceeds `long_side_px`.
    pub fn fitted(&self, long_side_px: u32) -> Self {
        self.resized(self.fitted_size(long_side_px))
    }

    /// This camera's picture size, shrunk by [`fitted_size`] if its long side exceeds `long_side_px`.
    pub fn fitted_size(&self, long_side_px: u32) -> [u32; 2] {
        fitted_size(self.size_px, long_side_px)
    }
}

/// All of `cameras`, or `count_max` of them at even intervals.
pub fn evenly_spaced(cameras: &[Camera], count_max: usize) -> Vec<Camera> {
    let count = cameras.len().min(count_max);
    (0..count).map(|i| cameras[i * cameras.len() / count]).collect()
}

/// Shrinks `size_px`, keeping its aspect ratio, so that the long side is at most `long_side_px`. The short side
/// is rounded to the nearest pixel. Never enlarges a side, and never returns a side of 0.
pub fn fitted_size(size_px: [u32; 2], long_side_px: u32) -> [u32; 2] {
    let long = size_px[0].max(size_px[1]);
    if long <= long_side_px {
        return size_px;
    }
    let fit = |side: u32| {
        let exact = f64::from(side) * f64::from(long_side_px) / f64::from(long);
        (exact.round() as u32).max(1)
    };
    [fit(size_px[0]), fit(size_px[1])]
}

/// The size of a scene as 3DGS defines it, in world units: 1.1 times the largest distance of a camera centre from
/// the mean of all camera centres; 0 for fewer than two cameras.
pub fn extent<'a>(cameras: impl Iterator<Item = &'a Camera> + Clone) -> f64 {
    let centers = cameras.map(|camera| camera.cam_from_world.center());
    let mean = centers.clone().sum::<DVec3>() / centers.clone().count().max(1) as f64;
    1.1 * centers.map(|center| center.distance(mean)).fold(0.0, f64::max)
}
