//! What each tile learns from: the parts of pictures that show it, and the splats around it that these parts show too.

use std::collections::{BTreeMap, BTreeSet};

use cosurf_engine::backend::Channels;
use cosurf_engine::{Capacity, Device};
use cosurf_scene::{Camera, Frustum, Splats};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::crop::{Part, crop};
use super::error::MergeError;
use super::memory::{lesson_bytes, student_bytes, teacher_bytes};
use super::pages::{Bounds, place};
use super::site::Site;
use super::tiles::Tile;

/// A camera that shows fewer points of a tile's ground does not teach the tile.
const SHOWN_MIN: usize = 2;
/// Share of a tile's splats in a picture that lie nearer than where the tile ends. Some splats float far behind it.
const INSIDE: f64 = 0.99;
/// A part shows splats up to this many times the depth at which the tile ends.
const FAR_TIMES: f64 = 1.05;
/// Number of points of the ground along the long side of a picture.
const SURFACE_ACROSS: f64 = 24.0;

/// One camera of one local model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct ViewKey {
    pub(super) local: usize,
    pub(super) camera: usize,
}

/// What a tile learns from.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Plan {
    pub(super) tile: Tile,
    /// The part of each camera's picture that shows the ground of the tile.
    pub(super) crops: BTreeMap<ViewKey, Part>,
    /// The part of each camera's picture with splats of the tile, visible or hidden; one for each pose.
    pub(super) wide_crops: Vec<Camera>,
    /// The views that are taught, best first.
    pub(super) lessons: Vec<ViewKey>,
    /// Number of splats that are trained.
    pub(super) student: usize,
    /// Bytes that the distillation of the tile takes.
    pub(super) bytes: u64,
    /// For each model: the bytes that its largest part of a picture takes, without any splats.
    pub(super) picture_bytes: BTreeMap<usize, u64>,
}

impl Plan {
    /// Plans a tile. `lessons` has the cameras of each local model that may teach.
    pub(super) fn of(
        site: &Site,
        tile: Tile,
        lessons: &[Vec<usize>],
        device: &Device,
    ) -> Result<Self, MergeError> {
        let own = site.own(&tile)?;
        let (mut crops, mut wide_crops, mut ranked) = (BTreeMap::new(), Vec::new(), Vec::new());
        let (mut known, mut picture_bytes) = (BTreeSet::new(), BTreeMap::new());
        let ball = ball(&own.means);
        for local in site.observed.near(ball.0, ball.1) {
            let observations = site.observed.load(local)?;
            for (index, camera) in site.cameras[local].iter().enumerate() {
                // Behind all surfaces that a camera sees, it can show nothing.
                let reaches = site.observed.reaches(local, index, ball.0, ball.1);
                if !reaches || !Frustum::new(camera).touches(ball.0, ball.1) {
                    continue;
                }
                let seen = seen(camera, &own.means);
                if let Some(wide) = crop(camera, &projected(camera, &seen)) {
                    let most: &mut u64 = picture_bytes.entry(local).or_default();
                    *most = lesson_bytes(device, site.joined.sh_degree(), &wide).max(*most);
                    if known.insert(camera.cam_from_world.bits()) {
                        wide_crops.push(wide);
                    }
                }
                let view = ViewKey { local, camera: index };
                let mut shown = observations.surface(index);
                shown.retain(|place| tile.contains(*place));
                let Some(sight) = Sight::of(camera, shown, seen) else { continue };
                crops.insert(view, sight.part);
                if lessons[local].binary_search(&index).is_ok() {
                    ranked.push((sight.worth, view));
                }
            }
        }
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut plan = Self {
            tile,
            crops,
            wide_crops,
            lessons: ranked.into_iter().map(|(_, view)| view).collect(),
            student: own.len(),
            bytes: 0,
            picture_bytes,
        };
        plan.student += plan.others(site)?;
        plan.bytes = plan.needed(site, device);
        Ok(plan)
    }

    /// The cameras of the parts that teach, best first.
    pub(super) fn cameras(&self) -> Vec<Camera> {
        self.lessons.iter().map(|view| self.crops[view].camera).collect()
    }

    /// The splats to train: those of the tile, then others that a part shows. Also returns the number of the former.
    pub(super) fn student(&self, site: &Site) -> Result<(Splats, usize), MergeError> {
        let mut student = site.own(&self.tile)?;
        let count = student.len();
        let frusta = self.frusta();
        let wanted = |at: DVec3, radius: f64| self.is_other(&frusta, at, radius);
        site.joined.read(site.joined.all(), |bounds| touches(&frusta, bounds), wanted, &mut student)?;
        Ok((student, count))
    }

    /// Number of splats of other tiles that a part shows.
    fn others(&self, site: &Site) -> Result<usize, MergeError> {
        let frusta = self.frusta();
        let wanted = |at: DVec3, radius: f64| self.is_other(&frusta, at, radius);
        Ok(site.joined.count_wanted(site.joined.all(), |bounds| touches(&frusta, bounds), wanted)?)
    }

    /// Which model has most of the splats to train, and how many.
    pub(super) fn most_of(&self, site: &Site) -> Result<(usize, usize), MergeError> {
        let frusta = self.frusta();
        let wanted = |at: DVec3, radius: f64| {
            self.tile.contains(at) || frusta.iter().any(|frustum| frustum.touches(at, radius))
        };
        let near = |bounds: &Bounds| self.tile.touches(bounds.low, bounds.high) || touches(&frusta, bounds);
        let mut most = (0, 0);
        for (local, pages) in site.joined_pages.iter().enumerate() {
            let count = site.joined.count_wanted(pages.clone(), near, wanted)?;
            most = if count > most.1 { (local, count) } else { most };
        }
        Ok(most)
    }

    /// Whether a splat with this radius lies in another tile and touches any of the frusta.
    fn is_other(&self, frusta: &[Frustum], at: DVec3, radius: f64) -> bool {
        !self.tile.contains(at) && frusta.iter().any(|frustum| frustum.touches(at, radius))
    }

    fn frusta(&self) -> Vec<Frustum> {
        self.lessons.iter().map(|view| self.crops[view].frustum()).collect()
    }

    /// A measure of the time that an epoch takes: the pixels of all parts that teach, and a fifth of the splats that are
    /// trained on each of them. Measured on rendered Boruszyn: 0.43 µs for a pixel, 0.09 µs for a splat.
    pub(super) fn work(&self) -> u64 {
        let area = |camera: &Camera| u64::from(camera.size_px[0]) * u64::from(camera.size_px[1]);
        let pixels: u64 = self.cameras().iter().map(area).sum();
        pixels + (self.lessons.len() * self.student) as u64 / 5
    }

    /// Bytes that the distillation takes. The teachers come one after the other, before the student.
    fn needed(&self, site: &Site, device: &Device) -> u64 {
        let none = Splats::with_capacity(0, site.joined.sh_degree());
        let shape = Capacity::to_train(&none, &self.cameras(), Channels::Geometry);
        let student = student_bytes(device, &shape, self.student);
        let frusta = self.frusta();
        let locals: BTreeSet<usize> = self.lessons.iter().map(|view| view.local).collect();
        let teacher = |local: usize| {
            let splats = site.models.count(site.pages[local].clone(), |bounds| touches(&frusta, bounds));
            teacher_bytes(device, &shape, splats, self.crops.len())
        };
        locals.into_iter().map(teacher).fold(student, u64::max)
    }
}

/// How a camera sees the ground of a tile.
struct Sight {
    part: Part,
    /// Number of pixels on a square of one world unit, at the median depth.
    worth: f64,
}

impl Sight {
    /// `shown` has points of the tile's ground that the picture of `camera` shows. `seen` has the places of the tile's
    /// splats in that picture, visible or hidden.
    /// `None` if there are too few points.
    fn of(camera: &Camera, shown: Vec<DVec3>, seen: Vec<DVec3>) -> Option<Self> {
        if shown.len() < SHOWN_MIN {
            return None;
        }
        let spacing_px = f64::from(camera.size_px[0].max(camera.size_px[1])) / SURFACE_ACROSS;
        let around = |p_px: DVec2| [p_px - 0.5 * spacing_px, p_px + 0.5 * spacing_px];
        let places_px: Vec<DVec2> = projected(camera, &shown).into_iter().flat_map(around).collect();
        let cropped = crop(camera, &places_px)?;
        let [depth, end] = [(shown, 0.5), (seen, INSIDE)].map(|(places, share)| depth(camera, places, share));
        let far = FAR_TIMES * depth.max(end);
        let worth = camera.focal_px.x * camera.focal_px.y / (depth * depth);
        Some(Self { part: Part { camera: cropped, far }, worth })
    }
}

/// The places of splats with these means, as far as they lie inside a camera's picture; visible or hidden.
fn seen(camera: &Camera, means: &[[f32; 3]]) -> Vec<DVec3> {
    let frustum = Frustum::new(camera);
    means.iter().map(|mean| place(*mean)).filter(|place| frustum.contains(*place)).collect()
}

fn projected(camera: &Camera, places: &[DVec3]) -> Vec<DVec2> {
    places.iter().filter_map(|place| camera.project(*place)).collect()
}

/// The depth at which this share of the places, 0..1, lies nearer to the camera; 0 without places.
fn depth(camera: &Camera, places: Vec<DVec3>, share: f64) -> f64 {
    let mut depths: Vec<f64> = places.iter().map(|place| camera.cam_from_world.transform(*place).z).collect();
    if depths.is_empty() {
        return 0.0;
    }
    let at = (share * depths.len() as f64) as usize;
    *depths.select_nth_unstable_by(at, f64::total_cmp).1
}

/// Centre and radius of a ball around all means.
pub(super) fn ball(means: &[[f32; 3]]) -> (DVec3, f64) {
    let places = means.iter().map(|mean| place(*mean));
    let (low, high) = places
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), place| (low.min(place), high.max(place)));
    (0.5 * (low + high), 0.5 * low.distance(high))
}

/// Whether any frustum touches any splat of a page.
pub(super) fn touches(frusta: &[Frustum], bounds: &Bounds) -> bool {
    let (center, radius) = bounds.ball();
    frusta.iter().any(|frustum| frustum.touches(center, radius))
}
