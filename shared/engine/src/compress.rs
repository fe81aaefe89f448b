//! Local Model Compression (CoSurfGS, Eq. 5). Where models overlap, a model loses splats of ground that another model
//! owns. Splats that are least important to its cameras outside the overlap are removed first.
//!
//! The paper does not define overlap between drones without shared pictures, nor the owner of shared ground. Here a
//! camera overlaps if cameras of other models see enough of the surface in its picture, from a similar direction and
//! distance. The owner of a place is the model with the most cameras that see the place; on a tie, the first such
//! model. Every place thus has at most one owner, whatever the order of compression, and the owner never removes its
//! splats of that place.

use cosurf_scene::{Camera, Frustum, Splats, Watchers};
use glam::DVec3;
use rayon::prelude::*;
use tracing::info_span;

use crate::backend::Channels;
use crate::budget::Capacity;
use crate::device::{Device, DeviceError};
use crate::prune;
use crate::render::Renderer;

/// A camera overlaps if cameras of other models see at least this share of the surface in its picture.
const SHARE_MIN: f64 = 0.3;
/// Cosine of the largest angle, 30°, between the lines of sight of two cameras that see a point alike.
const SIGHT_COSINE_MIN: f64 = 0.866_025_403_784_438_6;
/// Range of the ratio of the depths of a point in two cameras that see it alike.
const DEPTH_RATIO: std::ops::RangeInclusive<f64> = 0.5..=2.0;
/// Largest share of a model's splats that is removed. It is so high that in practice all splats on ground that other
/// models own can be removed. A lower limit leaves two surfaces in one place.
const OVERLAP_MAX: f64 = 0.8;
/// Smallest number of a model's cameras that must see a place so that the model can own it. With one camera, the model
/// may show nothing there, because training may have removed splats that only one camera sees.
const OWNER_CAMERAS_MIN: usize = 2;
/// Long side of the renderings with which overlap is measured, px.
const SIZE_PX: u32 = 48;

/// What compression removes from a model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Compression {
    /// Ψ, the share of the model's cameras that overlap, 0..=1. At most this share of the splats is removed.
    pub overlap: f64,
    /// Indices of the removed splats, ascending.
    pub removed: Vec<u32>,
}

/// The cameras of all models, and which of these models is compressed.
#[derive(Clone, Copy, Debug)]
pub struct ModelCameras<'a> {
    /// Cameras of each model. Every device that compresses must use the same cameras in the same order, so that all
    /// devices agree on the owners.
    pub cameras: &'a [Vec<Camera>],
    /// Index of the model that is compressed.
    pub own: usize,
}

impl Compression {
    /// Decides which splats compression removes. `splats` is the model with the index `models.own`, and `its` are the
    /// cameras of that model. Importance is measured with those of its cameras that do not overlap, or with all if
    /// every camera overlaps. The CPU uses `threads` threads, at least 1.
    pub fn plan(
        splats: &Splats,
        its: &[Camera],
        models: &ModelCameras,
        device: &Device,
        threads: usize,
    ) -> Result<Self, DeviceError> {
        let others: Vec<Camera> = models
            .cameras
            .iter()
            .enumerate()
            .filter(|(i, _)| *i != models.own)
            .flat_map(|(_, c)| c)
            .copied()
            .collect();
        if others.is_empty() || splats.is_empty() || its.is_empty() {
            return Ok(Self::default());
        }
        let _span = info_span!("compress", model = models.own, splats = splats.len()).entered();
        let mut renderer = Renderer::by(device, threads, splats)?;
        let mut others = Watchers::new(&others);
        let overlapping = its.iter().map(|camera| overlaps(&mut renderer, camera, &mut others));
        let overlapping: Vec<bool> = overlapping.collect::<Result<_, _>>()?;
        drop(renderer);
        let overlap = overlapping.iter().filter(|o| **o).count() as f64 / its.len() as f64;
        if overlap == 0.0 {
            return Ok(Self::default());
        }
        let separate: Vec<Camera> =
            its.iter().zip(&overlapping).filter(|(_, o)| !**o).map(|(camera, _)| *camera).collect();
        let judges = if separate.is_empty() { its } else { &separate[..] };
        let capacity = Capacity::to_train(splats, judges, Channels::Color);
        let importance = prune::importance(splats, judges, capacity, device, threads)?;
        let count = (overlap.min(OVERLAP_MAX) * splats.len() as f64) as usize;
        Ok(Self { overlap, removed: lowest(&importance, &owned_by_others(splats, models), count) })
    }
}

/// Whether `camera` overlaps: whether `others` see at least [`SHARE_MIN`] of the surface in its picture.
fn overlaps(renderer: &mut Renderer, camera: &Camera, others: &mut Watchers) -> Result<bool, DeviceError> {
    let camera = camera.resized(camera.fitted_size(SIZE_PX));
    let depth = renderer.try_render(&camera)?.depth;
    let pose = &camera.cam_from_world;
    let (world_from_cam, eye) = (pose.rotation.inverse(), pose.center());
    let width = camera.size_px[0] as usize;
    let (mut shown, mut seen) = (0usize, 0usize);
    for (i, z) in depth.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let p_px = glam::DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let point = eye + world_from_cam * (camera.ray(p_px) * f64::from(*z));
        shown += 1;
        seen += usize::from(others.any(point, |other| is_alike(&camera, other, point)));
    }
    Ok(shown > 0 && seen as f64 >= SHARE_MIN * shown as f64)
}

/// Whether `other` sees a point from a similar direction and distance as `camera`. `camera` itself may look elsewhere.
pub fn sees_alike(camera: &Camera, other: &Camera, point: DVec3) -> bool {
    other.sees(point) && is_alike(camera, other, point)
}

/// Whether two cameras look at a point from a similar direction and distance.
fn is_alike(camera: &Camera, other: &Camera, point: DVec3) -> bool {
    let sight = |camera: &Camera| (point - camera.cam_from_world.center()).normalize_or_zero();
    let depth = |camera: &Camera| camera.cam_from_world.transform(point).z;
    sight(camera).dot(sight(other)) >= SIGHT_COSINE_MIN
        && DEPTH_RATIO.contains(&(depth(other) / depth(camera)))
}

/// Indices, ascending, of the splats on ground that another model owns.
fn owned_by_others(splats: &Splats, models: &ModelCameras) -> Vec<u32> {
    let frusta: Vec<Vec<Frustum>> =
        models.cameras.iter().map(|its| its.iter().map(Frustum::new).collect()).collect();
    let is_owned_by_other = |i: &u32| {
        let mean = DVec3::from_array(splats.means[*i as usize].map(f64::from));
        let seers = |its: &Vec<Frustum>| its.iter().filter(|frustum| frustum.contains(mean)).count();
        let seen: Vec<usize> = frusta.iter().map(seers).collect();
        let most = seen.iter().copied().max().unwrap_or(0);
        most >= OWNER_CAMERAS_MIN && seen.iter().position(|count| *count == most) != Some(models.own)
    };
    (0..splats.len() as u32).into_par_iter().filter(is_owned_by_other).collect()
}

/// The `count` least important of `candidates`, ascending by index. Of equally important splats, those with the highest
/// indices are taken.
fn lowest(importance: &[f32], candidates: &[u32], count: usize) -> Vec<u32> {
    let mut order = candidates.to_vec();
    let key = |i: u32| importance[i as usize];
    order.sort_unstable_by(|&a, &b| key(a).total_cmp(&key(b)).then(b.cmp(&a)));
    order.truncate(count);
    order.sort_unstable();
    order
}
