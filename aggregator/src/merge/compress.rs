//! Local Model Compression (CoSurfGS, Eq. 5): what a model shows of ground that models before it show as well is
//! theirs, as far as it is worth little to the model's other cameras.
//!
//! The paper leaves open what "overlap" is between drones that share no picture, and in which order models yield.
//! Here: a camera overlaps if enough of the surface in its picture is seen by some camera of a model before it,
//! from a similar direction and distance; models yield to those before them in the order of their devices, so one
//! owner keeps shared ground. What fewer than two of the owners' cameras see is never removed: no hole appears
//! where an owner looks but has nothing.

use cosurf_engine::Renderer;
use cosurf_scene::{Camera, Splats};
use glam::DVec3;
use rayon::prelude::*;

use super::worth;

/// Share of a picture's surface that must be seen from elsewhere for its camera to overlap.
const SHARE_MIN: f64 = 0.3;
/// Largest angle between the two lines of sight, 30°, as a cosine.
const SIGHT_COSINE_MIN: f64 = 0.866_025_403_784_438_6;
/// Range of the ratio of the two depths.
const DEPTH_RATIO: std::ops::RangeInclusive<f64> = 0.5..=2.0;
/// Most of a model that goes.
const OVERLAP_MAX: f64 = 0.8;
/// Cameras of the owners that must see a splat that goes.
const OWNERS_MIN: usize = 2;
/// Long side of the pictures in which overlap is looked for, px.
const SIZE_PX: u32 = 48;

/// What goes of a model.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Compression {
    /// Ψ, the share of cameras that overlap, 0..=1.
    pub(crate) overlap: f64,
    /// Indices of splats, ascending.
    pub(crate) removed: Vec<u32>,
}

impl Compression {
    /// Decides what of a model goes where models with the cameras `before` come first.
    pub(crate) fn plan(splats: &Splats, cameras: &[Camera], before: &[Camera], threads: usize) -> Self {
        if before.is_empty() || splats.is_empty() || cameras.is_empty() {
            return Self::default();
        }
        let mut renderer = Renderer::new(splats, threads);
        let overlapping: Vec<bool> =
            cameras.iter().map(|camera| overlaps(&mut renderer, camera, before)).collect();
        drop(renderer);
        let overlap = overlapping.iter().filter(|o| **o).count() as f64 / cameras.len() as f64;
        if overlap == 0.0 {
            return Self::default();
        }
        let alone: Vec<Camera> =
            cameras.iter().zip(&overlapping).filter(|(_, o)| !**o).map(|(camera, _)| *camera).collect();
        let judges = if alone.is_empty() { cameras } else { &alone };
        let worth = worth(splats, judges, threads);
        let count = (overlap.min(OVERLAP_MAX) * splats.len() as f64) as usize;
        Self { overlap, removed: lowest(&worth, &shared(splats, before), count) }
    }
}

/// Whether enough of what the model shows a camera is seen by some of `before`.
fn overlaps(renderer: &mut Renderer, camera: &Camera, before: &[Camera]) -> bool {
    let camera = camera.resized(camera.fitted_size(SIZE_PX));
    let depth = renderer.render(&camera).depth;
    let pose = &camera.cam_from_world;
    let (world_from_cam, eye) = (pose.rotation.inverse(), pose.center());
    let width = camera.size_px[0] as usize;
    let (mut shown, mut seen) = (0usize, 0usize);
    for (i, z) in depth.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let p_px = glam::DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let point = eye + world_from_cam * (camera.ray(p_px) * f64::from(*z));
        shown += 1;
        seen += usize::from(before.iter().any(|other| sees_alike(&camera, other, point)));
    }
    shown > 0 && seen as f64 >= SHARE_MIN * shown as f64
}

/// Whether `other` sees a point that `camera` sees from a similar direction and distance.
fn sees_alike(camera: &Camera, other: &Camera, point: DVec3) -> bool {
    let sight = |camera: &Camera| (point - camera.cam_from_world.center()).normalize_or_zero();
    let depth = |camera: &Camera| camera.cam_from_world.transform(point).z;
    other.sees(point)
        && sight(camera).dot(sight(other)) >= SIGHT_COSINE_MIN
        && DEPTH_RATIO.contains(&(depth(other) / depth(camera)))
}

/// Indices of the splats that enough of `before` see.
fn shared(splats: &Splats, before: &[Camera]) -> Vec<u32> {
    let is_shared = |i: &u32| {
        let mean = DVec3::from_array(splats.means[*i as usize].map(f64::from));
        before.iter().filter(|camera| camera.sees(mean)).take(OWNERS_MIN).count() == OWNERS_MIN
    };
    (0..splats.len() as u32).into_par_iter().filter(is_shared).collect()
}

/// The `count` of `candidates` that are worth least, ascending; of equals the later.
fn lowest(worth: &[f32], candidates: &[u32], count: usize) -> Vec<u32> {
    let mut order = candidates.to_vec();
    let key = |i: u32| worth[i as usize];
    order.sort_unstable_by(|&a, &b| key(a).total_cmp(&key(b)).then(b.cmp(&a)));
    order.truncate(count);
    order.sort_unstable();
    order
}
