//! Local Model Compression (CoSurfGS, Eq. 5): where models overlap, a model loses the splats of ground that another
//! model owns, least important to its other cameras first.
//!
//! The paper does not define overlap between drones without shared pictures, nor the owner of shared ground. Here a
//! camera overlaps if cameras of other models see enough of its surface from a similar direction and distance. The
//! owner of a place is the model with the most cameras that see it; on a tie, the first. Every place thus has
//! at most one owner, independent of the order of compression, and no two models remove the same ground.

use cosurf_scene::{Camera, Frustum, Splats, Watchers};
use glam::DVec3;
use rayon::prelude::*;
use tracing::info_span;

use crate::backend::Channels;
use crate::budget::Capacity;
use crate::device::{Device, DeviceError};
use crate::prune;
use crate::render::Renderer;

/// Share of its surface that cameras of other models must see for a camera to overlap.
const SHARE_MIN: f64 = 0.3;
/// Largest angle between the two lines of sight, 30°, as a cosine.
const SIGHT_COSINE_MIN: f64 = 0.866_025_403_784_438_6;
/// Range of the ratio of the two depths.
const DEPTH_RATIO: std::ops::RangeInclusive<f64> = 0.5..=2.0;
/// Largest share of a model that is removed: in practice all that other models own. A lower limit leaves two surfaces
/// in one place (table "Largest removed share").
const OVERLAP_MAX: f64 = 0.8;
/// Smallest number of cameras with which an owner sees a place. Splats that a single camera sees may have been removed.
const OWNER_CAMERAS_MIN: usize = 2;
/// Long side of the renderings that measure overlap, px.
const SIZE_PX: u32 = 48;

/// What compression removes from a model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Compression {
    /// Ψ, the share of the model's cameras that overlap, 0..=1.
    pub overlap: f64,
    /// Indices of the removed splats, ascending.
    pub removed: Vec<u32>,
}

/// The cameras of all models that may overlap.
#[derive(Clone, Copy, Debug)]
pub struct ModelCameras<'a> {
    /// Cameras of each model. All devices that compress must use the same cameras in the same order.
    pub cameras: &'a [Vec<Camera>],
    /// Index of the model that is compressed.
    pub own: usize,
}

impl Compression {
    /// Plans the compression of `splats`: model `models.own`, with cameras `its`. Importance is measured with
    /// the cameras that do not overlap, else with all; the CPU uses `threads` threads, at least 1.
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

/// Whether a camera of the model overlaps: `others` see enough of the surface that the camera sees.
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

/// Whether `other` sees a point, from a similar direction and distance as `camera`.
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

/// Indices of the splats on ground that another model owns.
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

/// The `count` least important of `candidates`, ascending; of equally important splats, the last.
fn lowest(importance: &[f32], candidates: &[u32], count: usize) -> Vec<u32> {
    let mut order = candidates.to_vec();
    let key = |i: u32| importance[i as usize];
    order.sort_unstable_by(|&a, &b| key(a).total_cmp(&key(b)).then(b.cmp(&a)));
    order.truncate(count);
    order.sort_unstable();
    order
}
