//! How far the splats of a model are from the true surface.

use cosurf_scene::{Camera, Caster, evenly_spaced};
use glam::DVec3;
use rayon::prelude::*;

/// Pictures of the true surface that splats are compared with, and the long side of these, px.
const VIEWS_MAX: usize = 64;
const SIDE_PX: u32 = 480;

/// Distance of each place from the true surface along the rays of cameras: the least of all cameras that see the surface there.
/// Not a number for a place that is on no picture. A place is never nearer to the surface than half of a pixel tells. All are
/// in one frame, in its units.
pub(crate) fn splat_errors(places: &[DVec3], cameras: &[Camera], truth: &Caster) -> Vec<f32> {
    let mut errors = vec![f32::NAN; places.len()];
    for camera in evenly_spaced(cameras, VIEWS_MAX) {
        let camera = camera.fitted(SIDE_PX);
        let cast = truth.cast(&camera);
        let [width, height] = camera.size_px.map(f64::from);
        let error = |place: &DVec3| {
            let at = camera.cam_from_world.rotation * *place + camera.cam_from_world.translation;
            let x = at.x / at.z * camera.focal_px.x + camera.center_px.x;
            let y = at.y / at.z * camera.focal_px.y + camera.center_px.y;
            let is_on = at.z > 0.0 && (0.0..width).contains(&x) && (0.0..height).contains(&y);
            let depth =
                f64::from(cast.depth[if is_on { y as usize * width as usize + x as usize } else { 0 }]);
            // Along the ray, which is longer than the depth.
            let error = (at.z - depth).abs() * at.length() / at.z;
            if is_on && depth > 0.0 { error as f32 } else { f32::NAN }
        };
        // `min` takes the number if the other one is none.
        errors.par_iter_mut().zip(places).for_each(|(least, place)| *least = least.min(error(place)));
    }
    errors
}

#[cfg(test)]
mod tests {
    use cosurf_scene::{Mesh, Pose};
    use glam::DVec2;

    use super::*;

    #[test]
    fn the_error_of_a_place_is_its_height_above_flat_ground() {
        let positions = vec![[-50.0, -50.0, 0.0], [50.0, -50.0, 0.0], [50.0, 50.0, 0.0], [-50.0, 50.0, 0.0]];
        let mesh = Mesh { positions, triangles: vec![[0, 1, 2], [0, 2, 3]], ..Mesh::default() };
        let above = |x: f64| Camera {
            cam_from_world: Pose::look_at(DVec3::new(x, 0.0, 20.0), DVec3::new(x, 0.0, 0.0), DVec3::Y),
            focal_px: DVec2::splat(240.0),
            center_px: DVec2::splat(120.0),
            size_px: [240; 2],
        };
        // The fourth one is on the first picture alone, the last one on none.
        let places = [[0.0, 0.0, 0.0], [1.0, 2.0, 0.3], [1.0, 2.0, -0.5], [-8.0, 0.0, 0.2], [40.0, 0.0, 0.0]]
            .map(DVec3::from);
        let errors = splat_errors(&places, &[above(0.0), above(3.0)], &Caster::new(&mesh));
        let expected = [0.0, 0.3, 0.5, 0.2];
        for (error, expected) in errors.iter().zip(expected) {
            assert!((error - expected).abs() < 0.03, "{errors:?}");
        }
        assert!(errors[4].is_nan(), "no camera sees it: {errors:?}");
    }
}
