//! Poses that are learnt along with the splats, for pictures whose poses are not exact. After each rendering, the view's
//! camera moves so that the rendering fits the photograph better ([`crate::align`]).
//!
//! If all cameras moved alike, splats could follow and no picture would change. So that the frame stays that of the given
//! poses, the mean motion of all cameras and the growth of their distances are taken out again.
//!
//! A single view whose pose is wrong by degrees is neither corrected nor left out. Its rendering resembles its photograph far
//! less than those of the others do, after an eighth of the steps. But leaving out those that correlate by less than 0.55, 5 to 7
//! of 8 wrong ones, changed the held-out PSNR by -0.1, -1.9, +0.1 and +1.4 dB (Caliterra, Boruszyn, rendered Boruszyn, gt_tiny;
//! 160 px, 400 steps): what these views show is missing then.
//!
//! Whether poses are exact shows in the first part of a training: the model is a compromise between all views, and for each
//! view the shift between its photograph and its rendering is measured. Until all are measured, no camera moves, so that exact
//! poses give the same bits as fixed ones.

use std::fmt;
use std::str::FromStr;

use cosurf_scene::{Camera, Pose};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::align::{Found, MOTION, Motion, Prior, align, scaled_axis};
use crate::backend::{Rendering, TargetRgb};
use crate::schedule::Schedule;

/// Standard deviation of given rotations about each axis, rad: two degrees.
const ROTATION: f64 = 0.035;
/// Standard deviation of given positions along each axis, as a share of the scene's extent.
const TRANSLATION: f64 = 0.005;

/// Poses are not exact if the median shift between photograph and rendering is larger than [`SHIFT_MIN`], a share of the
/// picture's long side, and explains more than [`EXPLAINED_MIN`] of their squared difference; or if the shift is larger than
/// [`SHIFT_SURE`]. Of exact poses, the first is 0.0005 to 0.0010, but up to 0.0022 if the model is
/// blurred (300 steps of gt_tiny), and the second is 0.003 to 0.021; with poses that are off by 0.2° they are 0.0026 to
/// 0.0044 and 0.027 to 0.12 (Caliterra, Boruszyn, rendered Boruszyn, gt_tiny; 160 to 240 px).
const SHIFT_MIN: f64 = 0.0012;
const EXPLAINED_MIN: f64 = 0.022;
const SHIFT_SURE: f64 = 0.005;

/// Sides of the blocks of pixels in which a camera is aligned: one part in so many of the picture's long side at first, then
/// one in so many, but at least [`BLOCK_PX_MIN`].
const COARSE: u32 = 60;
const FINE: u32 = 160;
const BLOCK_PX_MIN: u32 = 2;
/// Number of coarse steps of a camera that is aligned by itself, and number of all.
const COARSE_STEPS: u32 = 3;
const STEPS: u32 = 8;

/// Numbers of a view in a checkpoint.
const NUMBERS: usize = MOTION + 3;

/// Whether the poses of the photographs are learnt.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum PoseChoice {
    /// They are learnt if they turn out not to be exact.
    #[default]
    Auto,
    /// They are taken as exact.
    Fixed,
    /// They are learnt.
    Learn,
}

impl PoseChoice {
    const WORDS: [(&str, Self); 3] = [("auto", Self::Auto), ("fixed", Self::Fixed), ("learn", Self::Learn)];
}

impl FromStr for PoseChoice {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let found = Self::WORDS.into_iter().find(|(word, _)| *word == text);
        found.map(|(_, choice)| choice).ok_or("give `auto`, `fixed` or `learn`")
    }
}

impl TryFrom<String> for PoseChoice {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<PoseChoice> for String {
    fn from(choice: PoseChoice) -> Self {
        choice.to_string()
    }
}

impl fmt::Display for PoseChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let word = Self::WORDS.into_iter().find(|(_, choice)| choice == self).map_or("", |(word, _)| word);
        f.write_str(word)
    }
}

/// What a training found out about the poses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosesFound {
    /// Whether they were learnt.
    pub learnt: bool,
    /// Median over the views of the shift between photograph and rendering at the given pose, px; if poses are learnt, median
    /// of how far the rendering has moved since.
    pub median_px: f64,
}

/// Aligns a camera, of which this is the `rendering`, with its photograph. `render` renders the model, in which cameras have this
/// `extent`, world units. Returns the aligned camera and its rendering.
pub fn aligned<E>(
    camera: &Camera,
    mut rendering: Rendering,
    rgb: TargetRgb,
    extent: f64,
    mut render: impl FnMut(&Camera) -> Result<Rendering, E>,
) -> Result<(Camera, Rendering), E> {
    let mut now = *camera;
    for step in 0..STEPS {
        let prior = prior(Motion::between(&camera.cam_from_world, &now.cam_from_world), extent);
        let block_px = block_px(camera, step < COARSE_STEPS);
        let Some(found) = align(&now, &rendering, rgb, block_px, &prior) else { break };
        now.cam_from_world = found.motion.of(&now.cam_from_world);
        rendering = render(&now)?;
    }
    Ok((now, rendering))
}

fn prior(motion: Motion, extent: f64) -> Prior {
    Prior { motion, rotation: ROTATION, translation: TRANSLATION * extent }
}

fn block_px(camera: &Camera, is_coarse: bool) -> usize {
    let long_side_px = camera.size_px[0].max(camera.size_px[1]);
    (long_side_px / if is_coarse { COARSE } else { FINE }).max(BLOCK_PX_MIN) as usize
}

/// The poses of all views in a training.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Poses {
    choice: PoseChoice,
    /// Scene extent, world units.
    extent: f64,
    /// Long side of the largest picture, px.
    long_side_px: f64,
    /// First step in which views are aligned.
    from: u32,
    /// First step in which it is known whether the poses are exact.
    known_from: u32,
    /// First step with fine blocks.
    fine_from: u32,
    /// First step in which views are not aligned any more.
    until: u32,
    views: Vec<View>,
    /// Medians over the views that have been measured; 0 if they are too few.
    shift_px: f64,
    explained: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct View {
    given: Pose,
    /// Motion from the given pose: rotation, then translation. In f32, so that a checkpoint keeps all of it.
    motion: [f32; MOTION],
    /// The shift between photograph and rendering at the given pose, and the share of their squared difference that it
    /// explains; 0 if not measured.
    shift_px: f32,
    explained: f32,
    /// How far the picture has moved, px.
    moved_px: f32,
}

impl Poses {
    /// The given poses of these cameras, in a scene of this extent, world units. `None` if they stay as they are.
    pub(crate) fn new(
        choice: PoseChoice,
        schedule: &Schedule,
        cameras: &[Camera],
        extent: f64,
    ) -> Option<Self> {
        if choice == PoseChoice::Fixed {
            return None;
        }
        let view = |camera: &Camera| View {
            given: camera.cam_from_world,
            motion: [0.0; MOTION],
            shift_px: 0.0,
            explained: 0.0,
            moved_px: 0.0,
        };
        let [from, known_from, fine_from, until] = schedule.pose_steps(cameras.len());
        let views = cameras.iter().map(view).collect();
        let long_side_px = cameras.iter().flat_map(|camera| camera.size_px).max().map_or(1.0, f64::from);
        Some(Self {
            choice,
            extent,
            long_side_px,
            from,
            known_from,
            fine_from,
            until,
            views,
            shift_px: 0.0,
            explained: 0.0,
        })
    }

    /// Whether a step (counted from 0) aligns its view, so that [`Self::update`] follows it.
    pub(crate) fn aligns(&self, step: u32) -> bool {
        (self.from..self.until).contains(&step) && (step < self.known_from || self.are_learnt())
    }

    /// What is known after this many steps.
    pub(crate) fn found(&self, steps_done: u32) -> Option<PosesFound> {
        let learnt = self.are_learnt();
        let of = |view: &View| if learnt { view.moved_px } else { view.shift_px };
        (learnt || steps_done >= self.known_from)
            .then(|| PosesFound { learnt, median_px: median(self.views.iter().map(of)) })
    }

    fn are_learnt(&self) -> bool {
        let shift = self.shift_px / self.long_side_px;
        let are_wrong = shift > SHIFT_SURE || shift > SHIFT_MIN && self.explained > EXPLAINED_MIN;
        self.choice == PoseChoice::Learn || are_wrong
    }

    /// To be called before each step. Once it is known that the poses are not exact, all cameras move as they were measured.
    pub(crate) fn begin(&mut self, cameras: &mut [Camera], step: u32) {
        if step == self.known_from && self.choice == PoseChoice::Auto && self.are_learnt() {
            self.move_cameras(cameras);
        }
    }

    /// Aligns the view of a step, of which this is the rendering.
    pub(crate) fn update(
        &mut self,
        cameras: &mut [Camera],
        index: usize,
        rendering: &Rendering,
        rgb: TargetRgb,
        step: u32,
    ) {
        let camera = &mut cameras[index];
        let view = &mut self.views[index];
        let is_measured = self.choice == PoseChoice::Auto && step < self.known_from;
        let before = if is_measured { Motion::default() } else { view.motion() };
        let block_px = block_px(camera, step < self.fine_from);
        let found = align(camera, rendering, rgb, block_px, &prior(before, self.extent));
        let Some(Found { motion, moved_px, explained }) = found else { return };
        if is_measured {
            view.set_motion(&motion);
            view.shift_px = moved_px as f32;
            view.explained = explained as f32;
            self.summarize();
            return;
        }
        view.moved_px = moved_px as f32;
        view.set_motion(&Motion::between(&view.given, &motion.of(&camera.cam_from_world)));
        self.move_cameras(cameras);
    }

    /// Moves all cameras as their views tell, and keeps the frame.
    fn move_cameras(&mut self, cameras: &mut [Camera]) {
        self.place(cameras);
        self.keep_frame(cameras);
        for (view, camera) in self.views.iter_mut().zip(&*cameras) {
            view.set_motion(&Motion::between(&view.given, &camera.cam_from_world));
        }
        self.place(cameras);
    }

    /// Sets the poses of all cameras.
    fn place(&self, cameras: &mut [Camera]) {
        for (view, camera) in self.views.iter().zip(cameras) {
            camera.cam_from_world = view.motion().of(&view.given);
        }
    }

    /// Computes the medians.
    fn summarize(&mut self) {
        let measured: Vec<&View> = self.views.iter().filter(|view| view.shift_px > 0.0).collect();
        if 2 * measured.len() >= self.views.len() {
            self.shift_px = median(measured.iter().map(|view| view.shift_px));
            self.explained = median(measured.iter().map(|view| view.explained));
        }
    }

    /// Visits all numbers in a fixed order.
    pub(crate) fn export<E>(&self, mut visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        self.views.iter().map(|view| view.to_numbers()).try_for_each(|numbers| visit(&numbers))
    }

    /// Restores what [`Self::export`] visited, and sets the poses of all cameras.
    pub(crate) fn import<E>(
        &mut self,
        cameras: &mut [Camera],
        steps_done: u32,
        mut fill: impl FnMut(&mut [f32]) -> Result<(), E>,
    ) -> Result<(), E> {
        for view in &mut self.views {
            let mut numbers = [0.0; NUMBERS];
            fill(&mut numbers)?;
            view.set_numbers(numbers);
        }
        self.summarize();
        // A training that is extended has a later schedule, but its cameras have moved already.
        if self.views.iter().any(|view| view.moved_px > 0.0) {
            self.known_from = self.known_from.min(steps_done.saturating_sub(1));
        }
        if self.are_learnt() && (self.choice == PoseChoice::Learn || steps_done > self.known_from) {
            self.place(cameras);
        }
        Ok(())
    }

    /// Turns, moves and scales all cameras together so that they lie around the given ones.
    fn keep_frame(&self, cameras: &mut [Camera]) {
        let count = cameras.len() as f64;
        let turn = |given: &Pose, camera: &Camera| {
            scaled_axis(given.rotation.inverse() * camera.cam_from_world.rotation)
        };
        let pairs = self.views.iter().zip(cameras.iter());
        let back = pairs.map(|(view, camera)| turn(&view.given, camera)).sum::<DVec3>() / count;
        let back = DQuat::from_scaled_axis(back);
        let eye = |camera: &Camera| camera.cam_from_world.center();
        let given = || self.views.iter().map(|view| view.given.center());
        let middle = given().sum::<DVec3>() / count;
        let moved = cameras.iter().map(eye).sum::<DVec3>() / count;
        // Distances along the given ones: others would grow by the mere disorder of the cameras.
        let arms = || {
            given().zip(cameras.iter()).map(|(given, camera)| [given - middle, back * (eye(camera) - moved)])
        };
        let before: f64 = arms().map(|[given, _]| given.length_squared()).sum();
        let after: f64 = arms().map(|[given, now]| given.dot(now)).sum();
        let scale = if after > 0.0 { before / after } else { 1.0 };
        for camera in cameras {
            let center = middle + scale * (back * (eye(camera) - moved));
            let rotation = (camera.cam_from_world.rotation * back.inverse()).normalize();
            camera.cam_from_world = Pose { rotation, translation: -(rotation * center) };
        }
    }
}

impl View {
    fn motion(&self) -> Motion {
        Motion::from_array(self.motion.map(f64::from))
    }

    fn set_motion(&mut self, motion: &Motion) {
        self.motion = motion.to_array().map(|value| value as f32);
    }

    fn to_numbers(self) -> [f32; NUMBERS] {
        let [a, b, c, d, e, f] = self.motion;
        [a, b, c, d, e, f, self.shift_px, self.explained, self.moved_px]
    }

    fn set_numbers(&mut self, [a, b, c, d, e, f, shift_px, explained, moved_px]: [f32; NUMBERS]) {
        *self = Self { motion: [a, b, c, d, e, f], shift_px, explained, moved_px, ..*self };
    }
}

/// The median of values, the lower one of two; 0 without values.
fn median(values: impl Iterator<Item = f32>) -> f64 {
    let mut values: Vec<f32> = values.collect();
    values.sort_unstable_by(f32::total_cmp);
    values.get(values.len().saturating_sub(1) / 2).copied().map_or(0.0, f64::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::tests::{above, ground};
    use crate::render::Renderer;

    fn flight() -> Vec<Camera> {
        [[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]].map(|[x, y]| above(x, y)).to_vec()
    }

    fn poses(choice: PoseChoice, cameras: &[Camera]) -> Poses {
        Poses::new(choice, &Schedule::new(100), cameras, 4.0).expect("not fixed")
    }

    #[test]
    fn choices_parse_and_print_alike() {
        for word in ["auto", "fixed", "learn"] {
            assert_eq!(word.parse::<PoseChoice>().expect("a choice").to_string(), word);
        }
        assert!("Auto".parse::<PoseChoice>().is_err() && "".parse::<PoseChoice>().is_err());
    }

    #[test]
    fn cameras_that_move_alike_stay_where_they_were() {
        let given = flight();
        let mut poses = poses(PoseChoice::Learn, &given);
        let turn = DQuat::from_scaled_axis(DVec3::new(0.02, -0.01, 0.03));
        let mut cameras = given.clone();
        for camera in &mut cameras {
            let center = 1.05 * (turn * camera.cam_from_world.center()) + DVec3::new(0.3, 0.1, -0.2);
            let rotation = camera.cam_from_world.rotation * turn.inverse();
            camera.cam_from_world = Pose { rotation, translation: -(rotation * center) };
        }
        for (view, camera) in poses.views.iter_mut().zip(&cameras) {
            view.set_motion(&Motion::between(&view.given, &camera.cam_from_world));
        }
        poses.move_cameras(&mut cameras);
        for (given, camera) in given.iter().zip(&cameras) {
            let [given, camera] = [given, camera].map(|camera| camera.cam_from_world);
            assert!(given.center().distance(camera.center()) < 1e-5);
            assert!(given.rotation.angle_between(camera.rotation) < 1e-5);
        }
    }

    /// Measures poses of which each is turned by `turn`, rad, about another axis. Returns what is found, and whether cameras
    /// have moved.
    fn measured(choice: PoseChoice, turn: f64) -> (Poses, Vec<Camera>, bool) {
        let truth = flight();
        let mut renderer = Renderer::new(&ground(), 1);
        let photographs: Vec<Vec<f32>> = truth.iter().map(|camera| renderer.render(camera).rgb).collect();
        let axes = [DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y];
        let mut cameras = truth.clone();
        for (camera, axis) in cameras.iter_mut().zip(axes) {
            let wrong = Motion { rotation: turn * axis, translation: DVec3::ZERO };
            camera.cam_from_world = wrong.of(&camera.cam_from_world);
        }
        let given = cameras.clone();
        let mut poses = poses(choice, &given);
        let known_from = poses.known_from;
        for step in 0..=known_from {
            poses.begin(&mut cameras, step);
            let index = step as usize % cameras.len();
            if step < known_from && poses.aligns(step) {
                let shown = renderer.render(&cameras[index]);
                poses.update(&mut cameras, index, &shown, TargetRgb::Floats(&photographs[index]), step);
            }
        }
        let have_moved = cameras != given;
        (poses, cameras, have_moved)
    }

    #[test]
    fn exact_poses_are_found_to_be_exact_and_do_not_move() {
        let (poses, _, have_moved) = measured(PoseChoice::Auto, 0.0);
        let found = poses.found(poses.known_from).expect("known by now");
        assert!(!found.learnt && found.median_px < 0.05 && !have_moved, "{found:?}");
        assert!(!poses.aligns(poses.known_from), "no time is spent on them");
    }

    #[test]
    fn wrong_poses_are_found_to_be_wrong_and_move_towards_the_truth() {
        let (poses, cameras, have_moved) = measured(PoseChoice::Auto, 0.01);
        let found = poses.found(poses.known_from).expect("known by now");
        assert!(found.learnt && poses.aligns(poses.known_from) && have_moved);
        for (truth, camera) in flight().iter().zip(&cameras) {
            let off = truth.cam_from_world.rotation.angle_between(camera.cam_from_world.rotation);
            assert!(off < 0.004, "{off}");
        }
        assert_eq!(Poses::new(PoseChoice::Fixed, &Schedule::new(100), &cameras, 4.0), None);
    }

    #[test]
    fn a_checkpoint_keeps_all_poses() {
        for (choice, turn) in [(PoseChoice::Auto, 0.01), (PoseChoice::Auto, 0.0), (PoseChoice::Learn, 0.01)] {
            let (before, moved, _) = measured(choice, turn);
            let mut numbers = Vec::new();
            let visited: Result<(), ()> = before.export(|part| {
                numbers.extend_from_slice(part);
                Ok(())
            });
            let mut cameras = before
                .views
                .iter()
                .zip(&moved)
                .map(|(view, camera)| Camera { cam_from_world: view.given, ..*camera })
                .collect::<Vec<_>>();
            let mut after = poses(choice, &cameras);
            let mut rest = numbers.as_slice();
            let filled: Result<(), ()> = after.import(&mut cameras, before.known_from + 1, |part| {
                let (mine, others) = rest.split_at(part.len());
                part.copy_from_slice(mine);
                rest = others;
                Ok(())
            });
            assert_eq!((visited, filled), (Ok(()), Ok(())));
            assert_eq!((after, cameras), (before, moved), "{choice} {turn}");
        }
    }
}
