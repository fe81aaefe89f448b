//! A rendered view, prepared for fusion: for each pixel, whether it is trusted, with what weight, and how a difference
//! in depth converts to a distance from the surface.

use cosurf_engine::Rendering;
use cosurf_scene::Camera;
use glam::{DVec3, Mat3, Vec2, Vec3};
use rayon::prelude::*;

/// Pixels with a smaller alpha show no surface.
const ALPHA_MIN: f32 = 0.5;
/// Least cosine of the angle between viewing ray and surface normal at which depth is trusted: 80°, as in PGSR.
const COSINE_MIN: f32 = 0.173_648;

/// A pixel of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Texel {
    /// Depth along the optical axis, world units.
    pub(super) depth_m: f32,
    /// Distance from the surface's tangent plane per unit of depth: the dot product of the viewing ray (with z = 1) and
    /// the unit normal.
    pub(super) facing: f32,
    /// Weight in the fusion: the cosine of the angle between viewing ray and normal; 0 if the pixel is not trusted.
    pub(super) weight: f32,
    /// 8-bit sRGB; the fourth byte is padding.
    pub(super) rgb: [u8; 4],
}

/// A rendered view.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    /// Centre of the camera, world frame.
    pub(super) center: DVec3,
    /// Rotation, camera from world.
    pub(super) rotation: Mat3,
    pub(super) focal_px: Vec2,
    pub(super) center_px: Vec2,
    pub(super) size_px: [usize; 2],
    /// The pixels, row by row.
    pub(super) texels: Vec<Texel>,
}

impl Frame {
    /// The view of a camera, without pixels.
    pub(super) fn of(camera: &Camera) -> Self {
        let pose = camera.cam_from_world;
        Self {
            center: pose.center(),
            rotation: Mat3::from_quat(pose.rotation.as_quat()),
            focal_px: camera.focal_px.as_vec2(),
            center_px: camera.center_px.as_vec2(),
            size_px: camera.size_px.map(|side| side as usize),
            texels: Vec::new(),
        }
    }

    /// Decides which pixels of a rendering are trusted. A pixel that covers more than `pixel_most_m` (world units,
    /// across the line of sight) is not trusted.
    pub(super) fn new(camera: &Camera, rendering: &Rendering, pixel_most_m: f64) -> Self {
        let mut frame = Self::of(camera);
        let size_px = frame.size_px;
        let depth_most_m = (pixel_most_m * camera.focal_px.min_element()) as f32;
        let mut texels = vec![Texel::default(); size_px[0] * size_px[1]];
        texels.par_chunks_mut(size_px[0]).enumerate().for_each(|(y, row)| {
            for (x, texel) in row.iter_mut().enumerate() {
                *texel = frame.judge(rendering, depth_most_m, [x, y]);
            }
        });
        frame.texels = texels;
        frame
    }

    fn judge(&self, rendering: &Rendering, depth_most_m: f32, [x, y]: [usize; 2]) -> Texel {
        let i = y * self.size_px[0] + x;
        let depth_m = rendering.depth[i];
        // NaN fails these comparisons, so a pixel with NaN shows no surface.
        let is_surface = depth_m > 0.0 && depth_m < depth_most_m && rendering.alpha[i] >= ALPHA_MIN;
        if !is_surface {
            return Texel::default();
        }
        let step = |along: usize| self.slope(&rendering.depth, [x, y], along);
        let (Some(du), Some(dv)) = (step(0), step(1)) else { return Texel::default() };
        let ray = self.ray(x as f32 + 0.5, y as f32 + 0.5);
        let (a, b) = (du * self.focal_px.x, dv * self.focal_px.y);
        // The cross product of the surface's tangents, scaled so that its dot product with the ray is the depth.
        let normal = Vec3::new(-a, -b, depth_m + ray.x * a + ray.y * b);
        let facing = depth_m / normal.length();
        let cosine = facing / ray.length();
        if cosine.is_nan() || cosine < COSINE_MIN {
            return Texel::default();
        }
        let byte = |channel: usize| (rendering.rgb[3 * i + channel].clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        Texel { depth_m, facing, weight: cosine, rgb: [byte(0), byte(1), byte(2), 0] }
    }

    /// Change of depth per pixel along axis `along`: 0 for x, 1 for y. This is the smaller of the steps to the two
    /// neighbouring pixels, so that the edge of a roof is not taken for a slope. `None` if neither neighbour shows a
    /// surface.
    fn slope(&self, depth: &[f32], at: [usize; 2], along: usize) -> Option<f32> {
        let stride = [1, self.size_px[0]][along];
        let i = at[1] * self.size_px[0] + at[0];
        let surface = |z: f32| (z.is_finite() && z > 0.0).then_some(z);
        let after = (at[along] + 1 < self.size_px[along]).then(|| surface(depth[i + stride])).flatten();
        let before = (at[along] > 0).then(|| surface(depth[i - stride])).flatten();
        let steps = [after.map(|z| z - depth[i]), before.map(|z| depth[i] - z)];
        steps.into_iter().flatten().min_by(|a, b| a.abs().total_cmp(&b.abs()))
    }

    /// The viewing ray through a position in the picture, with z = 1, camera frame.
    pub(super) fn ray(&self, x_px: f32, y_px: f32) -> Vec3 {
        ((Vec2::new(x_px, y_px) - self.center_px) / self.focal_px).extend(1.0)
    }

    /// World position of the surface that a pixel shows.
    pub(super) fn point(&self, x: usize, y: usize) -> DVec3 {
        let texel = &self.texels[y * self.size_px[0] + x];
        let ray = self.ray(x as f32 + 0.5, y as f32 + 0.5);
        self.center + (self.rotation.transpose() * (ray * texel.depth_m)).as_dvec3()
    }

    /// The texel at a position in the picture; `None` if the position is outside or its pixel is not trusted. The depth
    /// is interpolated if the four surrounding pixels show one surface: their depths differ by at most `reach_m`,
    /// measured along the surface normal. All other values are those of the pixel at the position.
    #[inline]
    pub(super) fn sample(&self, p_px: Vec2, reach_m: f32) -> Option<Texel> {
        let [width, height] = self.size_px;
        if !(p_px.x >= 0.0 && p_px.y >= 0.0 && p_px.x < width as f32 && p_px.y < height as f32) {
            return None;
        }
        let mut texel = self.texels[p_px.y as usize * width + p_px.x as usize];
        if texel.weight == 0.0 {
            return None;
        }
        let corner = p_px - 0.5;
        if corner.min_element() >= 0.0 {
            let [x, y] = [corner.x as usize, corner.y as usize];
            if x + 1 < width && y + 1 < height {
                let i = y * width + x;
                let around = [i, i + 1, i + width, i + width + 1].map(|i| &self.texels[i]);
                if let Some(depth_m) = blend(around, corner - corner.floor(), reach_m / texel.facing) {
                    texel.depth_m = depth_m;
                }
            }
        }
        Some(texel)
    }
}

/// Depth between four pixels by bilinear interpolation; `t` is the position between them, 0..1. `None` unless all four
/// are trusted and their depths differ by at most `reach_m`.
#[inline]
fn blend(around: [&Texel; 4], t: Vec2, reach_m: f32) -> Option<f32> {
    let z = around.map(|texel| texel.depth_m);
    let low = z[0].min(z[1]).min(z[2]).min(z[3]);
    let high = z[0].max(z[1]).max(z[2]).max(z[3]);
    if around.iter().any(|texel| texel.weight == 0.0) || high - low > reach_m {
        return None;
    }
    let (top, bottom) = (z[0] + (z[1] - z[0]) * t.x, z[2] + (z[3] - z[2]) * t.x);
    Some(top + (bottom - top) * t.y)
}
