//! Ray casting of triangle meshes: the exact depth and normal at each pixel's centre.
//!
//! What it knows nothing about: colours, and what the depth is compared with.

use glam::{DMat3, DVec2, DVec3, Vec3};
use rayon::prelude::*;

use crate::bvh::{Bvh, Ray};
use crate::{Camera, Mesh};

/// Largest number of triangles of a [`Caster`].
pub const TRIANGLES_MAX: usize = crate::bvh::TRIANGLES_MAX;

/// Depth and normals of a mesh as a camera sees them. Where the mesh has a hole, they belong to the surface
/// behind the hole, if there is one. The ground-truth mesh of the synthetic city (crate `cosurf-city`) has
/// holes where fewer than three cameras look.
#[derive(Clone, Debug, PartialEq)]
pub struct Cast {
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// `[height, width]` depth along the optical axis, world units; 0 where there is no surface.
    pub depth: Vec<f32>,
    /// `[height, width]` unit normals in the camera frame, facing the camera; zero where there is no surface.
    pub normals: Vec<[f32; 3]>,
}

/// A mesh prepared for casting the rays of any number of cameras.
#[derive(Debug)]
pub struct Caster {
    bvh: Bvh,
    corners: Vec<[Vec3; 3]>,
}

impl Caster {
    /// Copies the triangles and builds a bounding volume hierarchy over them. Panics if there are more than
    /// [`TRIANGLES_MAX`] triangles.
    pub fn new(mesh: &Mesh) -> Self {
        let corners: Vec<[Vec3; 3]> = (0..mesh.triangles.len()).map(|i| mesh.corners(i)).collect();
        Self { bvh: Bvh::build(&corners), corners }
    }

    /// Depth and normal at every pixel's centre. Both sides of a triangle are visible. Runs in parallel; the
    /// result does not depend on the number of threads.
    pub fn cast(&self, camera: &Camera) -> Cast {
        let shooter = Shooter::new(camera);
        cast_pixels(camera.size_px, |p_px| self.intersect(&shooter, [p_px])[0].unwrap_or_default())
    }

    /// Like [`Self::cast`], but each normal is the normalised mean over the pixel's area (3 × 3 rays). A pixel
    /// of a photograph or a rendering is also a mean over its area. So when normals are compared, detail smaller
    /// than a pixel does not count as an error.
    pub fn cast_areas(&self, camera: &Camera) -> Cast {
        let shooter = Shooter::new(camera);
        cast_pixels(camera.size_px, |center_px| {
            let thirds = |i: usize| DVec2::new((i % 3) as f64, (i / 3) as f64) - 1.0;
            let hits =
                self.intersect(&shooter, std::array::from_fn::<_, 9, _>(|i| center_px + thirds(i) / 3.0));
            let normal: Vec3 = hits.iter().flatten().map(|(_, normal)| Vec3::from(*normal)).sum();
            // Ray 4 of the nine goes through the centre and gives the depth.
            hits[4].map_or_else(Default::default, |(depth, _)| (depth, normal.normalize_or_zero().into()))
        })
    }

    /// The height (world z) of the highest surface at or below `from` and straight below it, which is what an orthographic
    /// camera that looks down sees; `None` if there is none.
    pub fn height_below(&self, from: DVec3) -> Option<f64> {
        let ray = Ray { origin: from.as_vec3(), direction: Vec3::NEG_Z, t_min: 0.0, t_max: f32::INFINITY };
        let hit = self.bvh.nearest(&[ray])[0]?;
        // The plane of the triangle in double precision, as in `Shooter::meet`.
        let [a, b, c] = self.corners[hit.triangle as usize].map(|p| p.as_dvec3());
        let normal = (b - a).cross(c - a);
        // A wall's own plane does not tell where its edge is; the ray's hit does.
        if normal.z.abs() < 1e-3 * normal.length() {
            return Some(from.z - f64::from(hit.t));
        }
        Some(a.z - (normal.x * (from.x - a.x) + normal.y * (from.y - a.y)) / normal.z)
    }

    /// For each pixel position: depth and normal where its ray first meets the surface, or `None` if it meets
    /// no surface.
    fn intersect<const N: usize>(
        &self,
        shooter: &Shooter,
        at_px: [DVec2; N],
    ) -> [Option<(f32, [f32; 3])>; N] {
        let hits = self.bvh.nearest(&at_px.map(|p_px| shooter.ray(p_px)));
        std::array::from_fn(|i| {
            hits[i].map(|hit| shooter.meet(at_px[i], &self.corners[hit.triangle as usize]))
        })
    }
}

/// Calls `cast` with the centre of each pixel and collects the depths and normals that it returns.
fn cast_pixels(size_px: [u32; 2], cast: impl Fn(DVec2) -> (f32, [f32; 3]) + Sync) -> Cast {
    let [width, height] = size_px;
    let (depth, normals) = (0..height)
        .into_par_iter()
        .flat_map_iter(|y| (0..width).map(move |x| (x, y)))
        .map(|(x, y)| cast(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)))
        .unzip();
    Cast { size_px, depth, normals }
}

/// A camera, prepared for generating viewing rays.
#[derive(Clone, Copy, Debug)]
pub struct Shooter {
    camera: Camera,
    center: DVec3,
    world_from_cam: DMat3,
}

impl Shooter {
    /// Prepares the rays of `camera`.
    pub fn new(camera: &Camera) -> Self {
        Self {
            camera: *camera,
            center: camera.cam_from_world.center(),
            world_from_cam: DMat3::from_quat(camera.cam_from_world.rotation.inverse()),
        }
    }

    /// Half of the width that a pixel covers at depth 1, world units. If pixels are not square, the shorter
    /// side counts.
    pub fn half_pixel(&self) -> f32 {
        (0.5 / self.camera.focal_px.max_element()) as f32
    }

    /// The viewing ray through a pixel position. The ray's `t` is the depth along the optical axis, world
    /// units.
    #[inline]
    pub fn ray(&self, p_px: DVec2) -> Ray {
        Ray {
            origin: self.center.as_vec3(),
            direction: (self.world_from_cam * self.camera.ray(p_px)).as_vec3(),
            t_min: 0.0,
            t_max: f32::INFINITY,
        }
    }

    /// Intersects the ray through a pixel position with the plane of a triangle, in double precision. Returns
    /// the depth, and the plane's unit normal in the camera frame, facing the camera.
    pub fn meet(&self, p_px: DVec2, corners: &[Vec3; 3]) -> (f32, [f32; 3]) {
        let [a, b, c] = corners.map(|p| p.as_dvec3());
        let normal = (b - a).cross(c - a).normalize();
        let direction = self.world_from_cam * self.camera.ray(p_px);
        let along = normal.dot(direction);
        let depth = normal.dot(a - self.center) / along;
        let towards = if along > 0.0 { -normal } else { normal };
        let in_camera = self.camera.cam_from_world.rotation * towards;
        (depth as f32, in_camera.as_vec3().to_array())
    }
}

#[cfg(test)]
mod tests {
    //! Tests against planes whose depth and normal are known in closed form.

    use super::*;
    use crate::Pose;

    /// Two triangles in the plane `z = 2 + slope · x`, which form a square of 200 world units in x and y.
    fn slanted(slope: f32) -> Mesh {
        let corner = |x: f32, y: f32| [x, y, 2.0 + slope * x];
        Mesh {
            positions: vec![
                corner(-100.0, -100.0),
                corner(100.0, -100.0),
                corner(100.0, 100.0),
                corner(-100.0, 100.0),
            ],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        }
    }

    fn from_above() -> Camera {
        let eye = DVec3::new(3.0, -4.0, 30.0);
        Camera {
            cam_from_world: Pose::look_at(eye, eye - DVec3::Z, DVec3::Y),
            focal_px: DVec2::new(40.0, 44.0),
            center_px: DVec2::new(16.3, 11.2),
            size_px: [32, 24],
        }
    }

    #[test]
    fn a_slanted_plane_has_the_depth_and_normal_of_its_equation() {
        let (camera, slope) = (from_above(), 0.3);
        let cast = Caster::new(&slanted(slope as f32)).cast(&camera);
        // The camera looks down: its x axis is the world's x, and its z axis is the world's -z.
        let normal = DVec3::new(-slope, 0.0, -1.0).normalize();
        for (i, (depth, got)) in cast.depth.iter().zip(&cast.normals).enumerate() {
            let ray = camera.ray(DVec2::new((i % 32) as f64 + 0.5, (i / 32) as f64 + 0.5));
            // The camera is at x = 3 and z = 30. At depth d, a ray has the height 30 - d and x = 3 + ray.x d.
            // It meets the plane where 30 - d = 2 + slope x.
            let expected = (28.0 - slope * 3.0) / (1.0 + slope * ray.x);
            assert!((f64::from(*depth) - expected).abs() < 1e-5 * expected, "{i}: {depth} is not {expected}");
            assert!(Vec3::from(*got).as_dvec3().distance(normal) < 1e-6, "{i}: {got:?} is not {normal}");
        }
    }

    /// Three facets per pixel along x, alternately rising and falling.
    fn ridged() -> Mesh {
        // The surface is 28 below the camera and the focal length is 40 px, so a pixel covers 28 / 40 = 0.7
        // world units in x.
        let ridge = |k: u32| (3.0 + (f64::from(k) / 3.0 - 16.3) * 0.7) as f32;
        let corner = |k: u32, y: f32| [ridge(k), y, if k.is_multiple_of(2) { 2.0 } else { 2.07 }];
        Mesh {
            positions: (0..=96).flat_map(|k| [corner(k, -100.0), corner(k, 100.0)]).collect(),
            triangles: (0..192).map(|i| [i, i + 1, i + 2]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn the_normal_of_a_pixel_is_the_mean_of_its_facets() {
        let caster = Caster::new(&ridged());
        let (centers, areas) = (caster.cast(&from_above()), caster.cast_areas(&from_above()));
        assert_eq!(centers.depth, areas.depth);
        let slope = |normal: &[f32; 3]| f64::from(normal[0] / normal[2]);
        for (i, (center, area)) in centers.normals.iter().zip(&areas.normals).enumerate() {
            // The two outer facets of a pixel have the same slope, the middle facet has the opposite slope.
            let side = if i % 2 == 0 { 0.3 } else { -0.3 };
            assert!((slope(center) + side).abs() < 1e-3, "{i}: {center:?}");
            assert!((slope(area) - side / 3.0).abs() < 1e-3, "{i}: {area:?}");
        }
    }

    #[test]
    fn the_surface_below_a_point_has_the_height_of_its_equation() {
        let mut mesh = slanted(0.3);
        mesh.positions.extend([[3.0, -4.0, 20.0], [6.0, -4.0, 20.0], [3.0, -1.0, 20.0]]);
        mesh.triangles.push([4, 5, 6]);
        let caster = Caster::new(&mesh);
        let height = |x, y, z| caster.height_below(DVec3::new(x, y, z));
        assert_eq!(height(4.0, -3.5, 30.0), Some(20.0), "the highest surface counts");
        for (x, y) in [(4.0, -3.5), (-77.0, 31.0), (0.0, 0.0)] {
            let got = height(x, y, 19.0);
            assert!(got.is_some_and(|got| (got - (2.0 + 0.3 * x)).abs() < 1e-5), "{x} {y}: {got:?}");
        }
        assert_eq!(height(101.0, 0.0, 100.0), None);
        assert_eq!(height(0.0, 0.0, 1.0), None, "the surface lies above");
    }

    #[test]
    fn both_sides_are_visible_and_nearer_surfaces_occlude() {
        let mut mesh = slanted(0.0);
        mesh.triangles = mesh.triangles.iter().map(|&[a, b, c]| [a, c, b]).collect();
        let camera = from_above();
        let flipped = Caster::new(&mesh).cast(&camera);
        assert!(flipped.normals.iter().all(|n| n[2] < -0.999), "normals must face the camera");
        // A small triangle in front hides part of the plane.
        mesh.positions.extend([[3.0, -4.0, 20.0], [6.0, -4.0, 20.0], [3.0, -1.0, 20.0]]);
        mesh.triangles.push([4, 5, 6]);
        let cast = Caster::new(&mesh).cast(&camera);
        let near = cast.depth.iter().filter(|z| (**z - 10.0).abs() < 1e-4).count();
        let far = cast.depth.iter().filter(|z| (**z - 28.0).abs() < 1e-4).count();
        assert!(near > 40 && near + far == 32 * 24, "{near} {far}");
    }

    #[test]
    fn empty_and_degenerate_meshes_have_no_depth() {
        let camera = from_above();
        for mesh in [Mesh::default(), Mesh { triangles: vec![[0, 0, 1]], ..slanted(0.0) }] {
            let caster = Caster::new(&mesh);
            for cast in [caster.cast(&camera), caster.cast_areas(&camera)] {
                assert!(cast.depth.iter().all(|&z| z == 0.0) && cast.normals.iter().all(|&n| n == [0.0; 3]));
                assert_eq!(cast.depth.len(), 32 * 24);
            }
        }
    }
}
