//! Paints charts with what cameras show of them.
//!
//! A texel has the mean of what the cameras show that see its place, weighted by the fourth power of how many of their
//! pixels a metre of the surface has: the camera that sees it most squarely and most closely counts most, and where another
//! one is better, the colours change little by little. What no camera shows has the colours of the vertices.
//!
//! What it knows nothing about: where charts lie on the picture; files.

use cosurf_scene::{Frustum, Mesh};
use glam::{DVec2, DVec3, Vec3, Vec4};
use rayon::prelude::*;

use super::charts::Chart;
use super::raster::each_texel;
use crate::survey::depths::DepthMap;
use crate::survey::views::Picture;

/// Bytes of a texel while it is painted: sums of its weighted colours and of the weights.
pub(super) const TEXEL_BYTES: u64 = size_of::<Vec4>() as u64;
/// Weight of a vertex's colour: nothing beside that of a camera.
const VERTEX_WEIGHT: f32 = 1e-25;
/// A surface that is seen at a smaller cosine than this shows too little.
const COSINE_LEAST: f64 = 0.1;
/// How often colours spread to texels beside those that the triangles cover. Beyond these, texels have the chart's mean.
const SPREADS: usize = 6;

/// Charts that are painted.
pub(super) struct Painting<'a> {
    mesh: &'a Mesh,
    /// Side of a texel, metres.
    texel_m: f64,
    canvases: Vec<Canvas<'a>>,
}

/// A chart that is painted.
struct Canvas<'a> {
    chart: &'a Chart,
    /// Ball around it in the world: middle and radius, metres.
    ball: (DVec3, f64),
    /// For each texel: sums of weighted colours and weights.
    sums: Vec<Vec4>,
}

impl<'a> Painting<'a> {
    /// Charts of a mesh in the world, with the colours of its vertices.
    pub(super) fn new(mesh: &'a Mesh, charts: &'a [Chart], texel_m: f64) -> Self {
        let canvas = |chart: &'a Chart| {
            let corners = || chart.triangles.iter().flat_map(|triangle| mesh.corners(*triangle as usize));
            let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
            corners().for_each(|corner| (low, high) = (low.min(corner), high.max(corner)));
            let (low, high) = (low.as_dvec3(), high.as_dvec3());
            let ball = (mesh.origin + 0.5 * (low + high), 0.5 * low.distance(high));
            let mut canvas = Canvas { chart, ball, sums: vec![Vec4::ZERO; chart.texel_count() as usize] };
            canvas.add_vertices(mesh, texel_m);
            canvas
        };
        Self { mesh, texel_m, canvases: charts.par_iter().map(canvas).collect() }
    }

    /// Adds what a camera shows. The surface has voxels of `voxel_m`.
    pub(super) fn add(&mut self, map: &DepthMap, voxel_m: f64) {
        let (frustum, picture) = (Frustum::new(&map.camera), Picture::new(map, voxel_m));
        let (mesh, texel_m) = (self.mesh, self.texel_m);
        let canvases = self.canvases.par_iter_mut();
        canvases.filter(|canvas| frustum.touches(canvas.ball.0, canvas.ball.1)).for_each(|canvas| {
            canvas.add_picture(mesh, texel_m, map, &picture);
        });
    }

    /// The colours of each chart, row by row. Calls `place` with their number and colours.
    pub(super) fn finish(self, mut place: impl FnMut(usize, &Chart, &[[u8; 3]])) {
        for (i, canvas) in self.canvases.into_iter().enumerate() {
            place(i, canvas.chart, &canvas.colors());
        }
    }
}

impl Canvas<'_> {
    fn add_vertices(&mut self, mesh: &Mesh, texel_m: f64) {
        let (chart, width) = (self.chart, self.chart.size[0] as usize);
        for triangle in &chart.triangles {
            let rgb = mesh.triangles[*triangle as usize].map(|vertex| {
                let rgb = mesh.rgb.get(vertex as usize).copied().unwrap_or_default();
                Vec3::from(rgb.map(f32::from))
            });
            each_texel(chart.corners(mesh, *triangle, texel_m), |[x, y], weights| {
                let [a, b, c] = weights.as_vec3().to_array();
                let color = rgb[0] * a + rgb[1] * b + rgb[2] * c;
                self.sums[y * width + x] += VERTEX_WEIGHT * color.extend(1.0);
            });
        }
    }

    fn add_picture(&mut self, mesh: &Mesh, texel_m: f64, map: &DepthMap, picture: &Picture<'_>) {
        let (chart, width, eye) = (self.chart, self.chart.size[0] as usize, picture.eye());
        let focal_px = map.camera.focal_px.min_element();
        for triangle in &chart.triangles {
            let [a, b, c] = mesh.corners(*triangle as usize).map(|corner| mesh.origin + corner.as_dvec3());
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let cosine = |at: DVec3| normal.dot((eye - at).normalize_or_zero());
            if [a, b, c].map(cosine).into_iter().all(|cosine| cosine < COSINE_LEAST) {
                continue;
            }
            each_texel(chart.corners(mesh, *triangle, texel_m), |[x, y], weights| {
                let at = a * weights.x + b * weights.y + c * weights.z;
                let cosine = cosine(at);
                if cosine < COSINE_LEAST {
                    return;
                }
                let Some((px, depth_m)) = picture.shows(at) else { return };
                let px_per_m = cosine * focal_px / depth_m;
                let weight = px_per_m.powi(4) as f32;
                self.sums[y * width + x] += weight * color_at(map, px).extend(1.0);
            });
        }
    }

    /// The colours of all texels, also of those that no triangle covers.
    fn colors(self) -> Vec<[u8; 3]> {
        let [width, height] = self.chart.size.map(|side| side as usize);
        let color = |sum: &Vec4| (sum.w > 0.0).then(|| sum.truncate() / sum.w);
        let mut colors: Vec<Option<Vec3>> = self.sums.iter().map(color).collect();
        for _ in 0..SPREADS {
            colors = spread(&colors, width, height);
        }
        let known = || colors.iter().flatten();
        let mean = known().sum::<Vec3>() / known().count().max(1) as f32;
        let bytes = |color: &Option<Vec3>| color.unwrap_or(mean).to_array().map(|of| of.round() as u8);
        colors.iter().map(bytes).collect()
    }
}

/// Gives texels without a colour the mean of those around them.
fn spread(colors: &[Option<Vec3>], width: usize, height: usize) -> Vec<Option<Vec3>> {
    let mean = |i: usize| {
        let (x, y) = (i % width, i / width);
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        let around = rows.flat_map(|row| &colors[row * width..][x.saturating_sub(1)..(x + 2).min(width)]);
        let (sum, count) =
            around.flatten().fold((Vec3::ZERO, 0.0), |(sum, count), color| (sum + *color, count + 1.0));
        (count > 0.0).then(|| sum / count)
    };
    colors.iter().enumerate().map(|(i, color)| color.or_else(|| mean(i))).collect()
}

/// The colour of a picture between the centres of its pixels, 0..=255.
fn color_at(map: &DepthMap, px: DVec2) -> Vec3 {
    let [width, height] = map.camera.size_px.map(|side| side as usize);
    let at = (px - 0.5).max(DVec2::ZERO);
    let [x, y] = [(at.x as usize).min(width - 1), (at.y as usize).min(height - 1)];
    let of =
        |x: usize, y: usize| Vec3::from(map.rgb[y.min(height - 1) * width + x.min(width - 1)].map(f32::from));
    let [u, v] = [(at.x - x as f64).min(1.0) as f32, (at.y - y as f64).min(1.0) as f32];
    of(x, y).lerp(of(x + 1, y), u).lerp(of(x, y + 1).lerp(of(x + 1, y + 1), u), v)
}
