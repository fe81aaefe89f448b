//! Targets on the ground: black and white squares, as surveyors lay them out, on level ground that drones see.

use glam::{DVec3, Vec2, Vec3};

use super::random::Rng;
use super::sight::Sight;
use cosurf_scene::Camera;
use cosurf_scene::bvh::{Bvh, Ray};

/// Half of the side of a target, metres.
const HALF_SIDE_M: f32 = 0.6;
/// The ground below a target differs at most by so much from a level plane, metres.
const UNEVEN_MAX_M: f32 = 0.06;
/// A target lies on the ground below this height, metres: not on a roof.
const HEIGHT_MAX_M: f32 = 6.0;
/// At least so many cameras see a target.
const CAMERAS_MIN: usize = 4;
/// Places that are tried for each target.
const TRIES: usize = 400;
/// Share of light that the paint reflects, `[black, white]`.
const ALBEDOS: [f32; 2] = [0.03, 0.9];

/// The middle of each target.
#[derive(Clone, Debug, Default)]
pub(super) struct Targets(pub(super) Vec<DVec3>);

impl Targets {
    /// Up to `count` targets in a flown square with sides of twice `half_m`, spread over it; fewer if there is too little level
    /// ground.
    pub(super) fn lay_out(bvh: &Bvh, cameras: &[Camera], half_m: f32, count: usize, seed: u64) -> Self {
        let mut rng = Rng::new(seed, 11);
        let sight = Sight::new(bvh, cameras);
        let across = (count as f32).sqrt().ceil().max(1.0);
        let cell = |i: usize| Vec2::new(i as f32 % across, (i as f32 / across).floor());
        let mut place = |i: usize| {
            (0..TRIES).find_map(|_| {
                let inside = cell(i) + Vec2::new(rng.unit(), rng.unit());
                let at = (inside * (2.0 / across) - 1.0) * half_m;
                level_ground(bvh, at).filter(|middle| sight.seen_by(*middle, CAMERAS_MIN).is_some())
            })
        };
        Self((0..count).filter_map(&mut place).collect())
    }

    /// Share of light that a target reflects at `position`; `None` beside all targets.
    pub(super) fn albedo(&self, position: Vec3) -> Option<f32> {
        let near = self.0.iter().map(|middle| position - middle.as_vec3());
        let inside = |d: &Vec3| d.x.abs() < HALF_SIDE_M && d.y.abs() < HALF_SIDE_M && d.z.abs() < 0.5;
        near.into_iter().find(inside).map(|d| ALBEDOS[usize::from((d.x < 0.0) == (d.y < 0.0))])
    }
}

/// The point on the ground at `at`, if the ground is level around it.
fn level_ground(bvh: &Bvh, at: Vec2) -> Option<DVec3> {
    let height = |offset: Vec2| {
        let origin = (at + offset).extend(500.0);
        let down = Ray { origin, direction: -Vec3::Z, t_min: 0.0, t_max: 1000.0 };
        bvh.nearest(&[down])[0].map(|hit| origin.z - hit.t)
    };
    let middle = height(Vec2::ZERO).filter(|z| *z < HEIGHT_MAX_M)?;
    let is_level = |offset: Vec2| height(offset).is_some_and(|z| (z - middle).abs() < UNEVEN_MAX_M);
    let steps = [-1.0, -0.5, 0.0, 0.5, 1.0].map(|step| step * 1.3 * HALF_SIDE_M);
    let around = || steps.iter().flat_map(|y| steps.map(|x| Vec2::new(x, *y)));
    around().all(is_level).then(|| at.extend(middle).as_dvec3())
}
