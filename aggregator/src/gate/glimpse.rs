//! Renders a small picture of a model from one of its own cameras, and decides whether another model shows the same.
//!
//! The thresholds come from pairs of trained models in real and rendered missions. If two right models show the same
//! ground, their pictures correlate best without a shift, and their median depths agree. The picture of a moved or
//! scaled model correlates better some pixels off, or its depths differ. Models trained on colour alone have large
//! errors of depth, but with both signs.

use cosurf_engine::Renderer;
use cosurf_scene::{Camera, Watchers};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Long side of the pictures, px.
const SIZE_PX: u32 = 64;
/// Largest number of views that are rendered of each model.
pub(super) const VIEWS: usize = 12;
/// Cosine of 30°, the largest angle between two similar lines of sight to the same point.
const SIGHT_COSINE_MIN: f64 = 0.866_025_403_784_438_6;
/// Pixels with at most this alpha show no surface.
const ALPHA_MIN: f32 = 0.5;
/// Pixels with at most this alpha also show the colour of what lies behind the surface.
const OPAQUE_MIN: f32 = 0.95;
/// Two models are compared in a picture only if the other model's cameras see at least this share of the picture's
/// surface pixels. If the other model was pruned before upload, it must show a surface in this share of those pixels.
const SHARE_MIN: f64 = 0.3;
/// Two models are compared only in at least this many pixels.
const SHARED_PX_MIN: usize = 64;
/// Largest shift with which two pictures are compared, px along each axis.
const REACH_PX: isize = 6;
/// A model is in the wrong place only if its picture correlates best with a shift larger than this, px.
const OFF_PX: f64 = 1.5;
/// A model is in the wrong place only if the best correlation with a shift is above this.
const FOUND_MIN: f64 = 0.5;
/// A model is in the wrong place only if a shift raises the correlation by more than this.
const BETTER_MIN: f64 = 0.05;
/// Pictures with a lower correlation than this, without a shift, show different ground.
const ALIKE_MIN: f64 = 0.4;
/// Depths contradict each other only if the median of the logarithm of their ratio is farther from 0 than this.
const DEPTH_MAX: f64 = 0.03;
/// Depths contradict each other only if the logarithms of their ratio vary little: half of them differ from their
/// median by at most this share of the median.
const DEPTH_SPREAD_MAX: f64 = 0.25;
/// Pictures of the same ground differ by at most this much in their mean colours, whatever the exposure.
const BRIGHTER_MAX: f64 = 0.4;
/// Pictures cannot be compared if their colours vary by less than this (root mean square).
const CONTRAST_MIN: f64 = 0.02;

/// A small picture of a model from one of its own cameras.
#[derive(Serialize, Deserialize)]
pub(super) struct Glimpse {
    camera: Camera,
    /// `[height, width, rgb]`.
    rgb: Vec<f32>,
    /// `[height, width]` depth, world units; 0 where there is no surface.
    depth: Vec<f32>,
    /// `[height, width]` opacity, 0..=1.
    alpha: Vec<f32>,
}

impl Glimpse {
    /// Renders a view of a model. If the model was pruned before upload, only opaque pixels count as surface.
    pub(super) fn of(renderer: &mut Renderer, camera: &Camera, is_compressed: bool) -> Self {
        let alpha_min = if is_compressed { OPAQUE_MIN } else { ALPHA_MIN };
        let camera = camera.fitted(SIZE_PX);
        let rendering = renderer.render(&camera);
        let opaque = |(depth, alpha): (&f32, &f32)| if *alpha > alpha_min { *depth } else { 0.0 };
        let depth = rendering.depth.iter().zip(&rendering.alpha).map(opaque).collect();
        Self { camera, rgb: rendering.rgb, depth, alpha: rendering.alpha }
    }

    /// Width and height of the picture, px.
    pub(super) fn size_px(&self) -> [u32; 2] {
        self.camera.size_px
    }

    /// Share of the picture that shows a surface, 0..=1.
    pub(super) fn shown(&self) -> f64 {
        let shown = self.alpha.iter().filter(|alpha| **alpha > ALPHA_MIN).count();
        shown as f64 / self.alpha.len().max(1) as f64
    }

    /// The surface point in a pixel.
    pub(super) fn point(&self, i: usize) -> DVec3 {
        let pose = &self.camera.cam_from_world;
        let width = self.camera.size_px[0] as usize;
        let p_px = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        pose.center() + pose.rotation.inverse() * (self.camera.ray(p_px) * f64::from(self.depth[i]))
    }

    /// Median depth of the surface, world units; `None` if there is no surface.
    pub(super) fn median_depth(&self) -> Option<f64> {
        let mut depths: Vec<f64> =
            self.depth.iter().filter(|depth| **depth > 0.0).map(|depth| f64::from(*depth)).collect();
        (!depths.is_empty()).then(|| median(&mut depths))
    }

    /// Centre and radius of a ball around the surface.
    pub(super) fn ball(&self) -> (DVec3, f64) {
        let points = (0..self.depth.len()).filter(|i| self.depth[*i] > 0.0).map(|i| self.point(i));
        let (low, high) = points.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), point| {
            (low.min(point), high.max(point))
        });
        (0.5 * (low + high), 0.5 * low.distance(high))
    }

    /// Indices of the pixels whose surface some of `cameras` see from a similar direction; `None` if they are too
    /// few.
    pub(super) fn shared_with(&self, cameras: &[Camera]) -> Option<Vec<usize>> {
        let eye = self.camera.cam_from_world.center();
        let point = |i: usize| self.point(i);
        let shown: Vec<usize> = (0..self.depth.len()).filter(|i| self.depth[*i] > 0.0).collect();
        let mut watchers = Watchers::new(cameras);
        let is_seen = |i: &usize| {
            let point = point(*i);
            let sight = (point - eye).normalize_or_zero();
            let is_alike = |eye: DVec3| (point - eye).normalize_or_zero().dot(sight) >= SIGHT_COSINE_MIN;
            watchers.any(point, |camera| is_alike(camera.cam_from_world.center()))
        };
        let shared: Vec<usize> = shown.iter().copied().filter(is_seen).collect();
        let enough = SHARED_PX_MIN.max((SHARE_MIN * shown.len() as f64) as usize);
        (shared.len() >= enough).then_some(shared)
    }

    /// Whether another model shows the same at the `shared` pixels. `other` is its picture from the same camera. `None`
    /// if that cannot be decided, or if the other model was pruned before upload and shows too little surface at these
    /// pixels.
    pub(super) fn is_confirmed_by(
        &self,
        other: &Self,
        shared: &[usize],
        is_compressed: bool,
    ) -> Option<bool> {
        let told = shared.iter().filter(|i| other.depth[**i] > 0.0).count();
        if is_compressed && (told as f64) < SHARE_MIN * shared.len() as f64 {
            return None;
        }
        let is_deep = self.is_as_deep(other, shared)?;
        let in_place = self.correlation(other, shared, [0, 0])?;
        let nearby = (-REACH_PX..=REACH_PX).flat_map(|dy| (-REACH_PX..=REACH_PX).map(move |dx| [dx, dy]));
        let found = nearby.filter_map(|by| Some((self.correlation(other, shared, by)?, by)));
        let (best, [dx, dy]) = found.max_by(|a, b| a.0.total_cmp(&b.0))?;
        let off_px = libm::hypot(dx as f64, dy as f64);
        let is_moved = off_px > OFF_PX && best > FOUND_MIN && best > in_place + BETTER_MIN;
        Some(is_deep && !is_moved && in_place >= ALIKE_MIN && self.is_as_bright(other, shared))
    }

    /// Whether the mean colours of both pictures are near each other where both show a surface.
    fn is_as_bright(&self, other: &Self, shared: &[usize]) -> bool {
        let both = || shared.iter().filter(|&&i| other.depth[i] > 0.0);
        (0..3).all(|channel| {
            let difference = |&i: &usize| f64::from(other.rgb[3 * i + channel] - self.rgb[3 * i + channel]);
            let mean = both().map(difference).sum::<f64>() / both().count().max(1) as f64;
            mean.abs() <= BRIGHTER_MAX
        })
    }

    /// The colours of this model and of another one, for each of the `shared` pixels where both show the same
    /// surface, and the column and row of the pixel. `other` is the other model's picture from the same camera.
    pub(super) fn colors_with(
        &self,
        other: &Self,
        shared: &[usize],
    ) -> impl Iterator<Item = ([usize; 2], [[f32; 3]; 2])> {
        let is_same = move |i: &usize| {
            let is_opaque = self.alpha[*i].min(other.alpha[*i]) > OPAQUE_MIN;
            is_opaque && libm::log(f64::from(self.depth[*i] / other.depth[*i])).abs() <= DEPTH_MAX
        };
        let color = |of: &Self, i: usize| [0, 1, 2].map(|channel| of.rgb[3 * i + channel]);
        let width = self.camera.size_px[0] as usize;
        let place = move |i: usize| [i % width, i / width];
        shared.iter().copied().filter(is_same).map(move |i| (place(i), [color(self, i), color(other, i)]))
    }

    /// Whether the depths of both pictures agree where both show a surface; `None` if these pixels are too few.
    fn is_as_deep(&self, other: &Self, shared: &[usize]) -> Option<bool> {
        let both = shared.iter().filter(|&&i| other.depth[i] > 0.0);
        let ratios: Vec<f64> = both.map(|&i| libm::log(f64::from(self.depth[i] / other.depth[i]))).collect();
        if ratios.len() < SHARED_PX_MIN {
            return None;
        }
        let middle = median(&mut ratios.clone());
        let spread = median(&mut ratios.iter().map(|ratio| (ratio - middle).abs()).collect::<Vec<_>>());
        Some(middle.abs() <= DEPTH_MAX || spread > DEPTH_SPREAD_MAX * middle.abs())
    }

    /// Correlation, -1..=1, between the colours of this picture at the `shared` pixels and the colours of `other` at
    /// the pixels `[dx, dy]` further. `None` if too few pixels are left, or if the colours of this picture hardly
    /// vary.
    fn correlation(&self, other: &Self, shared: &[usize], [dx, dy]: [isize; 2]) -> Option<f64> {
        let [width, height] = self.camera.size_px.map(|size| size as usize);
        let pairs: Vec<[usize; 2]> = shared
            .iter()
            .filter_map(|&i| {
                let x = (i % width).checked_add_signed(dx).filter(|x| *x < width)?;
                let y = (i / width).checked_add_signed(dy).filter(|y| *y < height)?;
                Some([i, y * width + x])
            })
            .filter(|[_, there]| other.depth[*there] > 0.0)
            .collect();
        if pairs.len() < SHARED_PX_MIN {
            return None;
        }
        let count = pairs.len() as f64;
        // All three channels side by side, each with sums of its own: that is several times as fast as one after another.
        let color = |of: &Self, i: usize| [0, 1, 2].map(|channel| f64::from(of.rgb[3 * i + channel]));
        let mut means = [[0.0; 3]; 2];
        for [i, j] in &pairs {
            for (mean, color) in means.iter_mut().zip([color(self, *i), color(other, *j)]) {
                mean.iter_mut().zip(color).for_each(|(mean, value)| *mean += value / count);
            }
        }
        let mut sums = [[0.0; 3]; 3];
        for [i, j] in &pairs {
            let [here, there] = [color(self, *i), color(other, *j)];
            for channel in 0..3 {
                let [a, b] = [here[channel] - means[0][channel], there[channel] - means[1][channel]];
                sums[0][channel] += a * a;
                sums[1][channel] += b * b;
                sums[2][channel] += a * b;
            }
        }
        let [here, there, both] = sums.map(|sums| sums.iter().sum::<f64>());
        let is_patterned = (here / count).sqrt() >= CONTRAST_MIN;
        is_patterned.then(|| both / (here * there).sqrt().max(f64::MIN_POSITIVE))
    }
}

/// The median; 0 of no values. Changes the order of the values.
pub(super) fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}
