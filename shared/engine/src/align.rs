//! Direct alignment: finds the small motion of a camera with which its rendering fits the photograph better. One step of Gauss and
//! Newton (Lucas and Kanade 1981) on brightness, in blocks of pixels, with the depth of the rendering.

use cosurf_scene::picture::MASKED;
use cosurf_scene::{Camera, Pose};
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::backend::{Rendering, TargetRgb};
use crate::layout::constants::LUMA_WEIGHTS;

/// Numbers that are solved for: rotation, translation, and gain and offset of the brightness.
const UNKNOWNS: usize = 8;
/// Numbers of a motion.
pub(crate) const MOTION: usize = 6;
/// At least this share of the blocks must show a surface.
const SHOWN_MIN: f64 = 0.2;
/// A step moves the picture by at most so many blocks, on average.
const BLOCKS_MAX: f64 = 2.0;
/// Residuals above this multiple of the mean count less (Cauchy's weight; 2.38 standard deviations in Holland and Welsch
/// 1977, and a mean is 0.8 standard deviations).
const OUTLIERS_FROM: f64 = 3.0;
/// Errors of neighbouring blocks are alike, so this many blocks tell no more than one independent block would. With 16 instead of
/// 1,600, cameras that look straight down drift by 0.3° and 0.3 m in Caliterra: both move the picture alike.
const ALIKE: f64 = 1600.0;

/// A small motion of a camera: `cam_from_world` is first applied, then this rotation (axis times angle, rad) and translation,
/// both in the camera frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Motion {
    pub(crate) rotation: DVec3,
    /// World units.
    pub(crate) translation: DVec3,
}

impl Motion {
    /// The motion from one pose to another.
    pub(crate) fn between(from: &Pose, to: &Pose) -> Self {
        let turn = to.rotation * from.rotation.inverse();
        Self { rotation: scaled_axis(turn), translation: to.translation - turn * from.translation }
    }

    /// The pose after the motion.
    pub(crate) fn of(&self, pose: &Pose) -> Pose {
        let turn = DQuat::from_scaled_axis(self.rotation);
        Pose {
            rotation: (turn * pose.rotation).normalize(),
            translation: turn * pose.translation + self.translation,
        }
    }

    pub(crate) fn to_array(self) -> [f64; MOTION] {
        let ([a, b, c], [d, e, f]) = (self.rotation.to_array(), self.translation.to_array());
        [a, b, c, d, e, f]
    }

    pub(crate) fn from_array([a, b, c, d, e, f]: [f64; MOTION]) -> Self {
        Self { rotation: DVec3::new(a, b, c), translation: DVec3::new(d, e, f) }
    }

    fn times(self, factor: f64) -> Self {
        Self { rotation: factor * self.rotation, translation: factor * self.translation }
    }
}

/// Axis times angle, rad, of a rotation of at most half a turn.
pub(crate) fn scaled_axis(turn: DQuat) -> DVec3 {
    // Of the two quaternions of a rotation, the one with the smaller angle.
    if turn.w < 0.0 { -turn } else { turn }.to_scaled_axis()
}

/// How exact a pose is before any alignment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Prior {
    /// The motion from the given pose to the present one.
    pub(crate) motion: Motion,
    /// Standard deviation of the given rotation about each axis, rad.
    pub(crate) rotation: f64,
    /// Standard deviation of the given position along each axis, world units.
    pub(crate) translation: f64,
}

/// What one step of alignment found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Found {
    /// The motion of one step towards the pose in which the rendering fits its photograph best. It moves the picture by at most
    /// [`BLOCKS_MAX`].
    pub(crate) motion: Motion,
    /// How far the picture moves from the given pose to where this motion ends, root mean square over the picture, px.
    pub(crate) moved_px: f64,
    /// Share of the squared difference between rendering and photograph that the motion explains, beyond what gain and offset
    /// explain, 0..=1.
    pub(crate) explained: f64,
}

/// Compares the rendering of a camera with its photograph, in blocks of `block_px` × `block_px`. `None` if the rendering shows
/// too little surface.
pub(crate) fn align(
    camera: &Camera,
    rendering: &Rendering,
    rgb: TargetRgb,
    block_px: usize,
    prior: &Prior,
) -> Option<Found> {
    let blocks = Blocks::of(rendering, rgb, block_px);
    let residual = Residual::of(&blocks)?;
    let lines = 1..blocks.size[1].saturating_sub(1);
    let lines: Vec<Sums> = lines.into_par_iter().map(|y| blocks.sums_of_line(camera, y, &residual)).collect();
    let mut sums = Sums::default();
    lines.iter().for_each(|line| sums.add_all(line));
    let blocks_in_all = (blocks.size[0] * blocks.size[1]) as f64;
    if sums.count < SHOWN_MIN * blocks_in_all {
        return None;
    }
    sums.solve(prior, BLOCKS_MAX * block_px as f64)
}

/// A rendering and its photograph in blocks of pixels.
struct Blocks {
    /// Blocks across and down.
    size: [usize; 2],
    side_px: f64,
    blocks: Vec<Block>,
}

/// The means of a block of pixels.
#[derive(Clone, Copy)]
struct Block {
    /// Brightness of the rendering, 0 and up.
    rendered: f32,
    /// Brightness of the photograph, 0..=1.
    photographed: f32,
    /// Depth along the optical axis, world units; 0 if the block does not count.
    depth: f32,
}

/// Brightness of a colour.
fn luma(rgb: [f32; 3]) -> f32 {
    let [red, green, blue] = LUMA_WEIGHTS;
    red * rgb[0] + green * rgb[1] + blue * rgb[2]
}

impl Block {
    /// The block whose first pixel is `first`.
    fn of(rendering: &Rendering, rgb: TargetRgb, block_px: usize, first: usize) -> Self {
        let width = rendering.size_px[0] as usize;
        let (mut sums, mut counts) = ([0.0; 3], true);
        for at in (0..block_px).flat_map(|row| first + row * width..first + row * width + block_px) {
            let (photographed, is_taken) = photograph(rgb, at);
            let depth = rendering.depth[at];
            counts &= is_taken && depth > 0.0;
            let values = [luma(three(&rendering.rgb, at)), photographed, depth];
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
        let [rendered, photographed, depth] = sums.map(|sum| sum / (block_px * block_px) as f32);
        Self { rendered, photographed, depth: if counts { depth } else { 0.0 } }
    }
}

impl Blocks {
    fn of(rendering: &Rendering, rgb: TargetRgb, block_px: usize) -> Self {
        let [width, height] = rendering.size_px.map(|side| side as usize);
        let size = [width / block_px, height / block_px];
        let line = |y: usize| (0..size[0]).map(move |x| [x * block_px, y * block_px]);
        let of = |[x, y]: [usize; 2]| Block::of(rendering, rgb, block_px, y * width + x);
        let blocks: Vec<Block> = (0..size[1]).into_par_iter().flat_map_iter(|y| line(y).map(of)).collect();
        Self { size, side_px: block_px as f64, blocks }
    }

    /// Whether a block and its four neighbours count.
    fn counts(&self, at: usize) -> bool {
        [at, at - 1, at + 1, at - self.size[0], at + self.size[0]]
            .iter()
            .all(|at| self.blocks[*at].depth > 0.0)
    }

    /// The equations of a line of blocks, which has a line above and one below.
    fn sums_of_line(&self, camera: &Camera, y: usize, residual: &Residual) -> Sums {
        let mut sums = Sums::default();
        let across = self.size[0];
        let slope_y = ((y as f64 + 0.5) * self.side_px - camera.center_px.y) / camera.focal_px.y;
        for x in 1..across.saturating_sub(1) {
            let at = y * across + x;
            if !self.counts(at) {
                continue;
            }
            let slope_x = ((x as f64 + 0.5) * self.side_px - camera.center_px.x) / camera.focal_px.x;
            let inv_z = 1.0 / f64::from(self.blocks[at].depth);
            let way = |before: usize, after: usize| {
                f64::from(self.blocks[after].rendered - self.blocks[before].rendered) / (2.0 * self.side_px)
            };
            let by_px = [way(at - 1, at + 1), way(at - across, at + across)];
            let moves = moves([slope_x, slope_y], inv_z, camera);
            // A picture that moves by δ shows at a pixel what was δ before it.
            let by = |k: usize| -(by_px[0] * moves[0][k] + by_px[1] * moves[1][k]);
            let shown = f64::from(self.blocks[at].rendered);
            let row = [by(0), by(1), by(2), by(3), by(4), by(5), shown, 1.0];
            let error = f64::from(self.blocks[at].photographed) - shown;
            let is_sample = x.is_multiple_of(4) && y.is_multiple_of(4);
            sums.add(&row, error, residual.weight(error), is_sample.then_some(&moves));
        }
        sums
    }
}

/// Brightness of pixel `at`, 0..=1, and whether it counts.
fn photograph(rgb: TargetRgb, at: usize) -> (f32, bool) {
    match rgb {
        TargetRgb::Floats(values) => (luma(three(values, at)), true),
        TargetRgb::Bytes(values) => {
            let bytes = three(values, at);
            (luma(bytes.map(f32::from)) / 255.0, bytes != MASKED)
        }
    }
}

fn three<T: Copy>(values: &[T], at: usize) -> [T; 3] {
    [values[3 * at], values[3 * at + 1], values[3 * at + 2]]
}

/// How far, in px, a point moves in the picture (x, then y) with each number of a motion. The point lies in the direction
/// `[x, y, 1]` at depth `1 / inv_z`.
fn moves([x, y]: [f64; 2], inv_z: f64, camera: &Camera) -> [[f64; MOTION]; 2] {
    let [fx, fy] = camera.focal_px.to_array();
    [
        [-x * y, 1.0 + x * x, -y, inv_z, 0.0, -x * inv_z].map(|v| fx * v),
        [-1.0 - y * y, x * y, x, 0.0, inv_z, -y * inv_z].map(|v| fy * v),
    ]
}

/// The usual difference between photograph and rendering.
struct Residual {
    mean: f64,
    /// Mean absolute difference from the mean.
    spread: f64,
}

impl Residual {
    /// `None` if no block counts.
    fn of(blocks: &Blocks) -> Option<Self> {
        let each = || {
            let counted = blocks.blocks.iter().filter(|block| block.depth > 0.0);
            counted.map(|block| f64::from(block.photographed - block.rendered))
        };
        let count = each().count().max(1) as f64;
        let mean = each().sum::<f64>() / count;
        let spread = each().map(|error| (error - mean).abs()).sum::<f64>() / count;
        (spread > 0.0).then_some(Self { mean, spread })
    }

    fn weight(&self, error: f64) -> f64 {
        let times = (error - self.mean) / (OUTLIERS_FROM * self.spread);
        1.0 / (1.0 + times * times)
    }
}

/// Sums over blocks, from which the motion is solved.
#[derive(Default)]
struct Sums {
    /// Number of blocks.
    count: f64,
    weight: f64,
    squares: f64,
    matrix: [[f64; UNKNOWNS]; UNKNOWNS],
    right: [f64; UNKNOWNS],
    /// How the picture moves with the numbers of a motion, px².
    moves: [[f64; MOTION]; MOTION],
    samples: f64,
}

impl Sums {
    fn add(&mut self, row: &[f64; UNKNOWNS], error: f64, weight: f64, moves: Option<&[[f64; MOTION]; 2]>) {
        self.count += 1.0;
        self.weight += weight;
        self.squares += weight * error * error;
        for i in 0..UNKNOWNS {
            let weighted = weight * row[i];
            self.right[i] += weighted * error;
            for j in 0..=i {
                self.matrix[i][j] += weighted * row[j];
            }
        }
        let Some([by_x, by_y]) = moves else { return };
        self.samples += 1.0;
        for i in 0..MOTION {
            for j in 0..MOTION {
                self.moves[i][j] += by_x[i] * by_x[j] + by_y[i] * by_y[j];
            }
        }
    }

    fn add_all(&mut self, other: &Self) {
        self.count += other.count;
        self.weight += other.weight;
        self.squares += other.squares;
        self.samples += other.samples;
        let add = |sums: &mut [f64], others: &[f64]| {
            sums.iter_mut().zip(others).for_each(|(sum, other)| *sum += other);
        };
        add(self.matrix.as_flattened_mut(), other.matrix.as_flattened());
        add(&mut self.right, &other.right);
        add(self.moves.as_flattened_mut(), other.moves.as_flattened());
    }

    /// The most likely motion, shortened if it moves the picture by more than `most_px`.
    fn solve(mut self, prior: &Prior, most_px: f64) -> Option<Found> {
        let left = self.left_by_exposure()?;
        let noise = ALIKE * (self.squares / self.weight).max(1e-12);
        let deviations = [prior.rotation, prior.translation];
        for (i, moved) in prior.motion.to_array().into_iter().enumerate() {
            let certainty = noise / (deviations[i / 3] * deviations[i / 3]);
            self.matrix[i][i] += certainty;
            self.right[i] -= certainty * moved;
        }
        let solved = solve(self.matrix, self.right)?;
        let fits: f64 = solved.iter().zip(&self.right).map(|(by, right)| by * right).sum();
        let explained = (1.0 - (self.squares - fits) / left).clamp(0.0, 1.0);
        let motion: [f64; MOTION] = std::array::from_fn(|i| solved[i]);
        let moved_px = self.moved_px(&motion);
        let share = if moved_px > most_px { most_px / moved_px } else { 1.0 };
        let motion = Motion::from_array(motion).times(share);
        let (before, now) = (prior.motion.to_array(), motion.to_array());
        let moved_px = self.moved_px(&std::array::from_fn(|i| before[i] + now[i]));
        Some(Found { motion, moved_px, explained })
    }

    /// The sum of squares that gain and offset alone leave. `None` if it is 0.
    fn left_by_exposure(&self) -> Option<f64> {
        let [gain, offset] = [self.right[MOTION], self.right[MOTION + 1]];
        let (a, b, c) = (
            self.matrix[MOTION][MOTION],
            self.matrix[MOTION + 1][MOTION],
            self.matrix[MOTION + 1][MOTION + 1],
        );
        let det = a * c - b * b;
        let fits = (c * gain * gain - 2.0 * b * gain * offset + a * offset * offset) / det;
        Some(self.squares - fits).filter(|left| *left > 0.0)
    }

    /// How far the picture moves with a motion, root mean square, px.
    fn moved_px(&self, motion: &[f64; MOTION]) -> f64 {
        let squares = |i: usize| (0..MOTION).map(|j| motion[i] * self.moves[i][j] * motion[j]).sum::<f64>();
        ((0..MOTION).map(squares).sum::<f64>() / self.samples.max(1.0)).max(0.0).sqrt()
    }
}

/// Solves a symmetric system of which the lower triangle is given (Cholesky). `None` if it is not positive definite.
fn solve(mut a: [[f64; UNKNOWNS]; UNKNOWNS], mut b: [f64; UNKNOWNS]) -> Option<[f64; UNKNOWNS]> {
    for i in 0..UNKNOWNS {
        for j in 0..=i {
            let rest = a[i][j] - (0..j).map(|k| a[i][k] * a[j][k]).sum::<f64>();
            if i > j {
                a[i][j] = rest / a[j][j];
            } else if rest > 0.0 {
                a[i][i] = rest.sqrt();
            } else {
                return None;
            }
        }
        b[i] = (b[i] - (0..i).map(|k| a[i][k] * b[k]).sum::<f64>()) / a[i][i];
    }
    for i in (0..UNKNOWNS).rev() {
        b[i] = (b[i] - (i + 1..UNKNOWNS).map(|k| a[k][i] * b[k]).sum::<f64>()) / a[i][i];
    }
    Some(b)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::random::{Purpose, Random};
    use crate::render::Renderer;
    use cosurf_scene::Splats;
    use glam::DVec2;

    /// A camera 4 above the ground that looks straight down at `[x, y, 0]`.
    pub(crate) fn above(x: f64, y: f64) -> Camera {
        Camera {
            cam_from_world: Pose::look_at(DVec3::new(x, y, 4.0), DVec3::new(x, y, 0.0), DVec3::Y),
            focal_px: DVec2::splat(120.0),
            center_px: DVec2::new(64.0, 48.0),
            size_px: [128, 96],
        }
    }

    /// Almost level ground of flat splats with uneven colours.
    pub(crate) fn ground() -> Splats {
        const ACROSS: i32 = 60;
        let mut splats = Splats::with_capacity((ACROSS * ACROSS) as usize, 0);
        let mut random = Random::new(7, Purpose::Test, 0, 0);
        for (x, y) in (0..ACROSS).flat_map(|y| (0..ACROSS).map(move |x| (x, y))) {
            let place = [x, y].map(|at| 0.12 * (at - ACROSS / 2) as f32);
            let [u, v] = place;
            let grey = (3.1 * u).sin() * (2.3 * v).cos() + 0.5 * (5.3 * u + 4.1 * v).sin();
            let log_scales = [-2.1, -2.1, -6.0]; // wide enough that no gaps show
            // Splats cover each other in the same order from all cameras.
            let height = 0.02 * random.normal();
            splats.push([u, v, height], [1.0, 0.0, 0.0, 0.0], log_scales, 3.0, &[grey; 3]);
        }
        splats
    }

    #[test]
    fn points_move_in_the_picture_as_told() {
        let camera = above(0.2, 0.1);
        let point = camera.unproject(DVec2::new(31.0, 47.0), 2.5);
        let ray = camera.ray(DVec2::new(31.0, 47.0));
        let told = moves([ray.x, ray.y], 1.0 / 2.5, &camera);
        const STEP: f64 = 1e-6;
        for k in 0..MOTION {
            let at = |sign: f64| {
                let mut numbers = [0.0; MOTION];
                numbers[k] = sign * STEP;
                let moved = Motion::from_array(numbers).of(&camera.cam_from_world);
                Camera { cam_from_world: moved, ..camera }.project(point).expect("in front of the camera")
            };
            let by = (at(1.0) - at(-1.0)) / (2.0 * STEP);
            assert!((by - DVec2::new(told[0][k], told[1][k])).length() < 1e-4, "{k}: {by} {told:?}");
        }
    }

    #[test]
    fn motions_join_poses() {
        let from = above(0.2, 0.1).cam_from_world;
        let motion =
            Motion { rotation: DVec3::new(0.02, -0.03, 0.01), translation: DVec3::new(0.1, 0.2, -0.3) };
        let found = Motion::between(&from, &motion.of(&from));
        assert!(found.rotation.distance(motion.rotation) < 1e-12);
        assert!(found.translation.distance(motion.translation) < 1e-12);
    }

    /// How far a camera that is turned and moved lies beside the truth before and after some steps, px. The photograph is as
    /// bright as `gain` and `offset` tell.
    fn beside_px(gain: f32, offset: f32) -> [f64; 2] {
        let truth = above(0.2, 0.1);
        let mut renderer = Renderer::new(&ground(), 1);
        let photograph: Vec<f32> =
            renderer.render(&truth).rgb.iter().map(|value| gain * value + offset).collect();
        let wrong = Motion { rotation: DVec3::new(0.008, -0.012, 0.02), translation: DVec3::splat(0.01) };
        let mut now = Camera { cam_from_world: wrong.of(&truth.cam_from_world), ..truth };
        let beside = |camera: &Camera| {
            let place = |x: f64, y: f64| truth.unproject(DVec2::new(x, y), 4.0);
            let places = [place(16.0, 16.0), place(64.0, 48.0), place(112.0, 80.0)];
            let off = places.map(|place| {
                camera.project(place).expect("ahead").distance(truth.project(place).expect("ahead"))
            });
            off.into_iter().fold(0.0, f64::max)
        };
        let before = beside(&now);
        for _ in 0..8 {
            let motion = Motion::between(&truth.cam_from_world, &now.cam_from_world);
            let prior = Prior { motion: motion.times(0.0), rotation: 1.0, translation: 1.0 };
            let shown = renderer.render(&now);
            let found = align(&now, &shown, TargetRgb::Floats(&photograph), 2, &prior).expect("a surface");
            now.cam_from_world = found.motion.of(&now.cam_from_world);
        }
        [before, beside(&now)]
    }

    #[test]
    fn a_camera_finds_the_pose_of_its_photograph_whatever_the_exposure() {
        for (gain, offset) in [(1.0, 0.0), (0.7, 0.1)] {
            let [before, after] = beside_px(gain, offset);
            assert!(before > 1.5 && after < 0.05, "{gain} {offset}: {before} px, then {after} px");
        }
    }

    #[test]
    fn masked_pixels_and_pictures_without_surface_do_not_count() {
        let camera = above(0.2, 0.1);
        let shown = Renderer::new(&ground(), 1).render(&camera);
        let prior = Prior { motion: Motion::default(), rotation: 1.0, translation: 1.0 };
        let masked: Vec<u8> = MASKED.iter().copied().cycle().take(shown.rgb.len()).collect();
        assert_eq!(align(&camera, &shown, TargetRgb::Bytes(&masked), 2, &prior), None);
        let bare = Rendering { depth: vec![0.0; shown.depth.len()], ..shown.clone() };
        assert_eq!(align(&camera, &bare, TargetRgb::Floats(&shown.rgb), 2, &prior), None);
    }
}
