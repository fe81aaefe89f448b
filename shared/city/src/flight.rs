//! The flight: a lawn-mower pattern over the square with the camera looking straight down, then a
//! pattern with an oblique camera for each of four headings.

use glam::{DVec2, DVec3};

use super::random::Rng;
use super::settings::CitySettings;
use cosurf_scene::{Camera, Pose};

/// Focal length divided by the picture's long side: a field of view of 60 degrees across it.
const FOCAL_PER_LONG_SIDE: f64 = 0.866;
/// Ground width of a straight-down picture, divided by the distance between neighbouring pictures.
const OVERLAP: f64 = 3.0;
/// Least height of flight, metres: above every roof and mast on every hill.
const HEIGHT_MIN_M: f64 = 62.0;
/// Greatest height of flight, metres. It bounds the land that must be built; larger squares have less
/// overlap instead, but more detail.
const HEIGHT_MAX_M: f64 = 180.0;
/// Height of the oblique flights, divided by that of the first flight.
const OBLIQUE_HEIGHT: f64 = 0.92;
/// Fraction of the square's side that oblique cameras aim at; the far halves of their pictures show the rest.
const OBLIQUE_AIM: f64 = 0.8;
/// Offset of the principal point from the centre, divided by the picture's size.
const OFF_CENTER: DVec2 = DVec2::new(0.019, -0.023);
/// Half ranges of the jitter of a camera's position and of its target, divided by the height of flight.
const JITTER: (f64, f64) = (0.018, 0.035);

/// The path of the flight.
#[derive(Clone, Copy, Debug)]
pub(super) struct FlightPath {
    settings: CitySettings,
    height_m: f64,
}

impl FlightPath {
    pub(super) fn new(settings: &CitySettings) -> Self {
        let spacing_m = settings.extent_m / f64::from(down_count(settings.views)).sqrt();
        let height_m = (OVERLAP * spacing_m * FOCAL_PER_LONG_SIDE).clamp(HEIGHT_MIN_M, HEIGHT_MAX_M);
        Self { settings: *settings, height_m }
    }

    /// Width on the ground of a pixel that looks straight down, metres.
    pub(super) fn pixel_m(&self) -> f64 {
        let long_side = self.settings.size_px[0].max(self.settings.size_px[1]);
        self.height_m / (FOCAL_PER_LONG_SIDE * f64::from(long_side))
    }

    /// Distance from the centre up to which the cameras see ground, metres.
    pub(super) fn reach_m(&self) -> f64 {
        let [width, height] = self.settings.size_px.map(f64::from);
        let focal = FOCAL_PER_LONG_SIDE * width.max(height);
        // Slope of the ray through the picture's upper edge; its middle looks 45 degrees down.
        let half = (0.5 + OFF_CENTER.y.abs()) * height / focal;
        let slope = ((1.0 - half) / (1.0 + half)).max(0.22);
        let beyond = OBLIQUE_HEIGHT * self.height_m * (1.0 / slope - 1.0) * 1.12;
        0.5 * self.settings.extent_m * OBLIQUE_AIM + beyond.max(0.5 * self.height_m)
    }

    /// The cameras in the order of flight.
    pub(super) fn cameras(&self) -> Vec<Camera> {
        let mut rng = Rng::new(self.settings.seed, 3);
        let down = down_count(self.settings.views);
        let oblique = self.settings.views - down;
        let half = 0.5 * self.settings.extent_m;
        let mut poses: Vec<Pose> = lawn_mower(down, half)
            .map(|(at, heading)| {
                self.jittered_pose(&mut rng, at.extend(self.height_m), at.extend(0.0), heading)
            })
            .collect();
        let headings = [DVec3::Y, DVec3::X, DVec3::NEG_Y, DVec3::NEG_X];
        for (i, heading) in (0..).zip(headings) {
            let count = (oblique + i) / 4;
            let height = OBLIQUE_HEIGHT * self.height_m;
            for (at, _) in lawn_mower(count, half * OBLIQUE_AIM) {
                let target = at.extend(0.0);
                let eye = target - heading * height + DVec3::Z * height;
                poses.push(self.jittered_pose(&mut rng, eye, target, DVec3::Z));
            }
        }
        poses.into_iter().map(|pose| self.camera(pose)).collect()
    }

    /// A jittered pose at `eye` that looks at `target`.
    fn jittered_pose(&self, rng: &mut Rng, eye: DVec3, target: DVec3, up: DVec3) -> Pose {
        let mut jitter = |range: f64| {
            let mut one = || (2.0 * rng.unit_f64() - 1.0) * range * self.height_m;
            DVec3::new(one(), one(), one())
        };
        let (shift, turn, roll) = (jitter(JITTER.0), jitter(JITTER.1), jitter(JITTER.1));
        Pose::look_at(eye + shift, target + turn, up + roll / self.height_m)
    }

    fn camera(&self, cam_from_world: Pose) -> Camera {
        let size = DVec2::from(self.settings.size_px.map(f64::from));
        Camera {
            cam_from_world,
            focal_px: DVec2::splat(FOCAL_PER_LONG_SIDE * size.max_element()),
            center_px: size * (DVec2::splat(0.5) + OFF_CENTER),
            size_px: self.settings.size_px,
        }
    }
}

/// Number of views that look straight down.
fn down_count(views: u32) -> u32 {
    views.div_ceil(2)
}

/// `count` positions along rows over a square, flown in alternating directions, with the heading at each.
fn lawn_mower(count: u32, half_m: f64) -> impl Iterator<Item = (DVec2, DVec3)> {
    let rows = f64::from(count).sqrt().round().max(1.0) as u32;
    (0..rows).flat_map(move |row| {
        let (first, last) = (count * row / rows, count * (row + 1) / rows);
        let in_row = last - first;
        let y = half_m * ((2 * row + 1) as f64 / f64::from(rows) - 1.0);
        let forth = if row % 2 == 0 { 1.0 } else { -1.0 };
        (0..in_row).map(move |i| {
            let x = half_m * ((2 * i + 1) as f64 / f64::from(in_row) - 1.0);
            (DVec2::new(forth * x, y), DVec3::X * forth)
        })
    })
}
