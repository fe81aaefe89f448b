//! Renders a camera's picture, depth and normals with five rays per pixel, or nine where colours vary.

use glam::{DVec2, Vec3};
use rayon::prelude::*;

use super::appearance::{Appearance, Spot};
use super::light::{self, Light, Lit};
use super::mesh::{Mesh, Triangle};
use super::optics::Optics;
use super::paving::Land;
use super::plan::Plan;
use super::targets::Targets;
use cosurf_scene::bvh::{Bvh, Hit, Ray};
use cosurf_scene::raycast::Shooter;
use cosurf_scene::{Camera, Picture};

/// A rendering of the city by a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CityFrame {
    /// Colour; black where there is no surface.
    pub picture: Picture,
    /// Depth along the optical axis in metres at each pixel's centre, `[height, width]`; 0 where there is
    /// no surface.
    pub depth: Vec<f32>,
    /// Unit normals in the camera frame, facing the camera, at each pixel's centre, `[height, width]`;
    /// zero where there is no surface.
    pub normals: Vec<[f32; 3]>,
}

/// The complete town: geometry, materials and light.
#[derive(Debug)]
pub(super) struct World {
    pub(super) plan: Plan,
    pub(super) land: Land,
    pub(super) mesh: Mesh,
    pub(super) bvh: Bvh,
    pub(super) light: Light,
}

/// Sample positions within a pixel, in thirds of a pixel from its centre.
const MIDDLE_AND_CORNERS: [(f64, f64); 5] = [(0.0, 0.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)];
/// The other four of the 3 × 3 positions.
const SIDES: [(f64, f64); 4] = [(0.0, -1.0), (-1.0, 0.0), (1.0, 0.0), (0.0, 1.0)];
/// A pixel gets all nine samples if the square roots of its linear colours differ by more than this,
/// about 15 of 255 levels in the picture.
const UNEVEN: f32 = 0.06;

/// A pixel's values.
struct Pixel {
    rgb: [u8; 3],
    depth: f32,
    normal: [f32; 3],
}

/// A camera that takes a picture.
struct Eye<'a> {
    camera: &'a Camera,
    shooter: Shooter,
    optics: &'a Optics,
    targets: &'a Targets,
}

impl Eye<'_> {
    /// Where an ideal lens would show what the picture shows at `p_px`.
    fn ideal_px(&self, p_px: DVec2) -> DVec2 {
        self.optics.lens.undistorted(self.camera, p_px)
    }
}

impl World {
    /// Renders a picture with depth and normals, in parallel; the result does not depend on the number of
    /// threads.
    pub(super) fn render(&self, camera: &Camera, optics: &Optics, targets: &Targets) -> CityFrame {
        let [width, height] = camera.size_px;
        let eye = Eye { camera, shooter: Shooter::new(camera), optics, targets };
        let pixels: Vec<Pixel> = (0..height)
            .into_par_iter()
            .flat_map_iter(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| self.pixel(&eye, x, y))
            .collect();
        CityFrame {
            picture: Picture::new(camera.size_px, pixels.iter().flat_map(|p| p.rgb).collect()),
            depth: pixels.iter().map(|p| p.depth).collect(),
            normals: pixels.iter().map(|p| p.normal).collect(),
        }
    }

    fn pixel(&self, eye: &Eye, x: u32, y: u32) -> Pixel {
        let center = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let (hits, colors) = self.samples(eye, center, MIDDLE_AND_CORNERS);
        let color = if is_uneven(&colors) {
            let (_, more) = self.samples(eye, center, SIDES);
            colors.iter().chain(&more).sum::<Vec3>() * (1.0 / 9.0)
        } else {
            colors.iter().sum::<Vec3>() * 0.2
        };
        let (depth, normal) = match hits[0] {
            Some(hit) => {
                let corners = &self.mesh.triangles[hit.triangle as usize].corners;
                eye.shooter.meet(eye.ideal_px(center), corners)
            }
            None => (0.0, [0.0; 3]),
        };
        Pixel { rgb: light::encode(color * eye.optics.gain), depth, normal }
    }

    /// Hits and colours at offsets from a pixel's centre, given in thirds of a pixel.
    fn samples<const N: usize>(
        &self,
        eye: &Eye,
        center: DVec2,
        thirds: [(f64, f64); N],
    ) -> ([Option<Hit>; N], [Vec3; N]) {
        let at = |(dx, dy): (f64, f64)| eye.ideal_px(center + DVec2::new(dx, dy) * (1.0 / 3.0));
        let rays = thirds.map(|third| eye.shooter.ray(at(third)));
        let hits = self.bvh.nearest(&rays);
        (hits, self.shade(&rays, &hits, eye.shooter.half_pixel(), eye.targets))
    }

    /// Linear colours that the rays see; black for a ray that hits nothing. `footprint` is the distance
    /// between samples in metres per metre of ray; half a pixel for the samples within a pixel.
    pub(super) fn shade<const N: usize>(
        &self,
        rays: &[Ray; N],
        hits: &[Option<Hit>; N],
        footprint: f32,
        targets: &Targets,
    ) -> [Vec3; N] {
        let mut seen: [Option<(Lit, Appearance)>; N] = [None; N];
        for i in 0..N {
            seen[i] = hits[i].map(|hit| self.surface(&rays[i], &hit, footprint, targets));
        }
        let if_reached =
            |(lit, appearance): (Lit, Appearance)| self.light.reaches(&lit, &appearance).then_some(lit);
        let reached = seen.map(|surface| surface.and_then(if_reached));
        let sunny = self.light.sunny(&self.bvh, &reached);
        let mut colors = [Vec3::ZERO; N];
        for i in 0..N {
            if let Some((lit, appearance)) = &seen[i] {
                colors[i] = self.light.radiance(lit, appearance, sunny[i]);
            }
        }
        colors
    }

    /// The surface point that a ray hit, and its appearance.
    fn surface(&self, ray: &Ray, hit: &Hit, footprint: f32, targets: &Targets) -> (Lit, Appearance) {
        let length = ray.direction.length();
        let to_viewer = -ray.direction * (1.0 / length);
        let [a, b, c] = self.mesh.triangles[hit.triangle as usize].corners;
        let cross = (b - a).cross(c - a).normalize();
        let cosine = cross.dot(to_viewer);
        let normal = if cosine < 0.0 { -cross } else { cross };
        // Slanted surfaces stretch the footprint along one side; the textures get the mean of both sides.
        let stretch = 0.5 + 0.5 / cosine.abs().max(0.2);
        let footprint_m = footprint * hit.t * length * stretch;
        let spot = self.spot(hit.triangle, hit.barycentric, footprint_m);
        let appearance = match targets.albedo(spot.position) {
            Some(albedo) => Appearance::matt(Vec3::splat(albedo)),
            None => self.appearance(hit.triangle, &spot),
        };
        (Lit { position: spot.position, normal, to_viewer }, appearance)
    }

    /// The linear colour of a lit surface point, without view-dependent reflections.
    pub(super) fn matt_shade(
        &self,
        triangle: u32,
        weights: [f32; 2],
        normal: Vec3,
        footprint_m: f32,
    ) -> Vec3 {
        let spot = self.spot(triangle, weights, footprint_m);
        let lit = Lit { position: spot.position, normal, to_viewer: normal };
        let appearance = Appearance { mirror: 0.0, ..self.appearance(triangle, &spot) };
        let [sunny] = self.light.sunny(&self.bvh, &[self.light.reaches(&lit, &appearance).then_some(lit)]);
        self.light.radiance(&lit, &appearance, sunny)
    }

    fn appearance(&self, triangle: u32, spot: &Spot) -> Appearance {
        let material = self.mesh.triangles[triangle as usize].material;
        self.mesh.materials[material as usize].appearance(spot, &self.plan, &self.land)
    }

    fn spot(&self, triangle: u32, [v, w]: [f32; 2], footprint_m: f32) -> Spot {
        let Triangle { corners: [a, b, c], uvs, .. } = self.mesh.triangles[triangle as usize];
        Spot {
            position: a + (b - a) * v + (c - a) * w,
            uv: uvs[0] * (1.0 - v - w) + uvs[1] * v + uvs[2] * w,
            footprint_m,
        }
    }
}

fn is_uneven(colors: &[Vec3]) -> bool {
    let roots = |c: &Vec3| Vec3::new(c.x.max(0.0).sqrt(), c.y.max(0.0).sqrt(), c.z.max(0.0).sqrt());
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::ZERO);
    for root in colors.iter().map(roots) {
        low = low.min(root);
        high = high.max(root);
    }
    (high - low).max_element() > UNEVEN
}
