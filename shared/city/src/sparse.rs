//! The sparse cloud, made as structure from motion makes it: features at pixels of high contrast,
//! tracks through the pictures that see them, and positions triangulated from noisy observations.

use glam::{DMat3, DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::light;
use super::random::Rng;
use super::render::World;
use super::sight::Sight;
use super::targets::Targets;
use cosurf_scene::raycast::Shooter;
use cosurf_scene::{Camera, SparsePoint};

/// Standard deviation of an observation, per axis.
const NOISE_PX: f64 = 0.7;
/// Fraction of the points that are outliers, as from wrong matches.
const OUTLIERS: f32 = 0.03;
/// Least number of views of a track.
const TRACK_MIN: usize = 3;
/// Cosine of COLMAP's minimum triangulation angle of 1.5 degrees.
const COSINE_MAX: f64 = 0.999_66;
/// Side of the squares that get one feature each, in pictures of 320 pixels. Larger pictures have
/// larger squares, but more of them.
const SQUARE_PX: f64 = 25.0;
/// Pixels tried in each square; the pixel of highest contrast becomes the feature.
const TRIES: usize = 4;

/// The cloud of a flight.
pub(super) fn cloud(world: &World, cameras: &[Camera], seed: u64) -> Vec<SparsePoint> {
    let sight = Sight::new(&world.bvh, cameras);
    let per_view: Vec<Vec<SparsePoint>> = (0..cameras.len())
        .into_par_iter()
        .map(|view| {
            let rng = Rng::new(seed, 0x1000 + view as u64);
            Finder { world, sight: &sight, view, rng }.features()
        })
        .collect();
    per_view.into_iter().flatten().collect()
}

struct Finder<'a> {
    world: &'a World,
    sight: &'a Sight<'a>,
    view: usize,
    rng: Rng,
}

/// A surface point with its colour and local contrast.
struct Feature {
    position: DVec3,
    color: Vec3,
    contrast: f32,
}

impl Finder<'_> {
    fn features(&mut self) -> Vec<SparsePoint> {
        let [width, height] = self.camera().size_px.map(f64::from);
        let side = SQUARE_PX * (width.max(height) / 320.0).sqrt();
        let (columns, rows) = ((width / side).ceil() as u32, (height / side).ceil() as u32);
        let mut points = Vec::new();
        for row in 0..rows {
            for column in 0..columns {
                let corner = DVec2::new(f64::from(column), f64::from(row)) * side;
                let best = (0..TRIES)
                    .filter_map(|_| {
                        let p = corner + DVec2::new(self.rng.unit_f64(), self.rng.unit_f64()) * side;
                        self.feature(p)
                    })
                    .max_by(|a, b| a.contrast.total_cmp(&b.contrast));
                points.extend(best.and_then(|feature| self.point(&feature)));
            }
        }
        points
    }

    fn camera(&self) -> &Camera {
        &self.sight.cameras[self.view]
    }

    fn feature(&self, p_px: DVec2) -> Option<Feature> {
        if !self.camera().contains(p_px) {
            return None;
        }
        let shooter = Shooter::new(self.camera());
        let color = |p_px: DVec2| {
            let ray = shooter.ray(p_px);
            let [hit] = self.world.bvh.nearest(&[ray]);
            let [color] = self.world.shade(&[ray], &[hit], shooter.half_pixel(), &Targets::default());
            Some((color, hit?.t))
        };
        let (middle, depth) = color(p_px)?;
        let contrast = [DVec2::new(1.2, 0.3), DVec2::new(-0.3, 1.2), DVec2::new(-0.9, -0.9)]
            .iter()
            .filter_map(|&step| color(p_px + step))
            .map(|(c, _)| (c - middle).abs().element_sum())
            .fold(0.0, f32::max);
        let position = self.camera().unproject(p_px, f64::from(depth));
        Some(Feature { position, color: middle, contrast })
    }

    /// A feature's track and triangulated position.
    fn point(&mut self, feature: &Feature) -> Option<SparsePoint> {
        let views = self.track(feature.position);
        if views.len() < TRACK_MIN || self.narrow(feature.position, &views) {
            return None;
        }
        let observations: Vec<(usize, DVec2)> = views
            .iter()
            .filter_map(|&view| {
                let exact = self.sight.cameras[view].project(feature.position)?;
                Some((view, exact + DVec2::new(self.rng.normal(), self.rng.normal()) * NOISE_PX))
            })
            .collect();
        let mut position = triangulate(self.sight.cameras, &observations, feature.position)?;
        if self.rng.chance(OUTLIERS) {
            position = self.misplaced(position);
        }
        let views = views.into_iter().map(|view| view as u32).collect();
        Some(SparsePoint { position, rgb: light::encode(feature.color), views })
    }

    /// The views that see and recognise a position. A view is less likely to recognise it the more its
    /// direction differs.
    fn track(&mut self, position: DVec3) -> Vec<usize> {
        let direction =
            |view: usize| (position - self.sight.cameras[view].cam_from_world.center()).normalize();
        let here = direction(self.view);
        let likely: Vec<(usize, f64)> = (0..self.sight.cameras.len())
            .map(|view| (view, direction(view).dot(here)))
            .filter(|&(view, cosine)| cosine > 0.3 && self.sight.sees(view, position))
            .collect();
        likely
            .into_iter()
            .filter(|&(view, cosine)| {
                let recognised = self.rng.chance(if cosine > 0.85 { 0.85 } else { 0.4 });
                recognised || view == self.view
            })
            .map(|(view, _)| view)
            .collect()
    }

    /// Whether all lines of sight are nearly parallel.
    fn narrow(&self, position: DVec3, views: &[usize]) -> bool {
        let line = |view: usize| (position - self.sight.cameras[view].cam_from_world.center()).normalize();
        let first = line(views[0]);
        views.iter().all(|&view| line(view).dot(first) > COSINE_MAX)
    }

    /// The position of an outlier: displaced mostly along the line of sight.
    fn misplaced(&mut self, position: DVec3) -> DVec3 {
        let center = self.camera().cam_from_world.center();
        let line = position - center;
        let stretch = self.rng.range(0.04, 0.35) * if self.rng.chance(0.5) { 1.0 } else { -1.0 };
        let aside = DVec3::new(self.rng.normal(), self.rng.normal(), self.rng.normal());
        position + line * f64::from(stretch) + aside * (0.01 * line.length())
    }
}

/// The point whose projections best fit the observations, by Gauss-Newton steps from `start`.
fn triangulate(cameras: &[Camera], observations: &[(usize, DVec2)], start: DVec3) -> Option<DVec3> {
    const STEPS: usize = 3;
    let mut position = start;
    for _ in 0..STEPS {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for &(view, observed) in observations {
            let camera = &cameras[view];
            let residual = camera.project(position)? - observed;
            let p = camera.cam_from_world.transform(position);
            let rows = DMat3::from_quat(camera.cam_from_world.rotation).transpose();
            let gradients = [
                (rows.x_axis - rows.z_axis * (p.x / p.z)) * (camera.focal_px.x / p.z),
                (rows.y_axis - rows.z_axis * (p.y / p.z)) * (camera.focal_px.y / p.z),
            ];
            for (gradient, residual) in gradients.into_iter().zip(residual.to_array()) {
                normal +=
                    DMat3::from_cols(gradient * gradient.x, gradient * gradient.y, gradient * gradient.z);
                right += gradient * residual;
            }
        }
        if normal.determinant() <= 0.0 {
            return None;
        }
        position -= normal.inverse() * right;
    }
    position.is_finite().then_some(position)
}
