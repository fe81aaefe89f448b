//! Bundle adjustment: poses, lenses and points that agree best with all that is known together, the marks of the points in
//! the photographs, GPS, and the control points.
//!
//! COLMAP adjusts too, but knows only the photographs. They tell a level block from a bowl only faintly, most of all if all
//! look straight down; a control point tells it at once.
//!
//! Levenberg's and Marquardt's method: each step solves the normal equations of all poses and lenses ([`equations`]), in
//! double precision and exactly, because the bowl is what their solution knows least. Marks that are far off lose their
//! weight ([`problem`]).
//!
//! What it knows nothing about: files, COLMAP, geodesy. Where to start reading: [`adjust`].

mod envelope;
mod equations;
mod order;
mod problem;
mod projection;
#[cfg(test)]
mod tests;

use glam::{DVec2, DVec3};

use super::reconstruction::Reconstruction;
use envelope::Envelope;
use problem::{Anchor, LensEquation, Mark, Problem, State};
use projection::{POSE, Station, project};

/// Most steps; a flight takes five to fifteen.
const STEPS_MAX: usize = 40;
/// A step that improves the cost by less than this share is the last.
const CHANGE_MIN: f64 = 1e-7;
/// Damping at the start, and the one below which the faint directions count in full.
const DAMPING: f64 = 1e-6;
const DAMPING_END: f64 = 1e-10;
/// Damping above which no step improves anything.
const DAMPING_MAX: f64 = 1e4;
/// Standard deviation of a mark that somebody has set, pixels: at least.
const MARK_SIGMA_PX: f64 = 1.0;
/// Standard deviation of a tie point's mark, pixels: at least. Features are found to a tenth of a pixel.
const TIE_SIGMA_PX: f64 = 0.1;
/// For the median length of an error in two dimensions: 1 / sqrt(2 ln 2), of Rayleigh's distribution.
const SIGMA_PER_MEDIAN: f64 = 0.8493;
/// Most bytes of the equations' matrix.
const MATRIX_BYTES_MAX: usize = 2 << 30;

/// Where GPS puts a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct KnownCenter {
    /// Index of the photograph.
    pub(super) photograph: usize,
    /// In the frame of the reconstruction, metres.
    pub(super) at_m: DVec3,
    /// Inverse variances along x, y and z, 1/m².
    pub(super) weight: DVec3,
}

/// A measured point on the ground.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct KnownPoint {
    /// Where the photographs show it, in the frame of the reconstruction, metres.
    pub(super) seen_m: DVec3,
    /// Where it was measured.
    pub(super) at_m: DVec3,
    /// Inverse variances along x, y and z, 1/m².
    pub(super) weight: DVec3,
    /// Indices of photographs, and pixels.
    pub(super) marks: Vec<(usize, DVec2)>,
}

/// The equations take more memory than they may; nothing was changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct TooLarge {
    pub(super) bytes: usize,
}

/// Adjusts a reconstruction, whose frame must be that of the centres and points, to all of them.
pub(super) fn adjust(
    its: &mut Reconstruction,
    centers: &[KnownCenter],
    points: &[KnownPoint],
) -> Result<(), TooLarge> {
    if its.posed.is_empty() || its.marks.is_empty() {
        return Ok(());
    }
    let (mut problem, state) = pose(its, centers, points);
    let first = order::first_columns(&problem, &state);
    let bytes = Envelope::bytes(&first);
    if bytes > MATRIX_BYTES_MAX {
        return Err(TooLarge { bytes });
    }
    let sigma_px = spread_px(&problem, &state, its.marks.len());
    problem.marks[..its.marks.len()].iter_mut().for_each(|mark| mark.sigma_px = sigma_px);
    problem.marks[its.marks.len()..].iter_mut().for_each(|mark| mark.sigma_px = sigma_px.max(MARK_SIGMA_PX));
    let state = solve(&problem, state, &first);
    for (posed, Station { rotation, center }) in its.posed.iter_mut().zip(&state.stations) {
        posed.cam_from_world.rotation = *rotation;
        posed.cam_from_world.translation = -(*rotation * *center);
    }
    its.lenses = state.lenses;
    its.points.iter_mut().zip(&state.points).for_each(|(point, at)| point.position = *at);
    Ok(())
}

/// The problem, and the state that it begins with.
fn pose(its: &Reconstruction, centers: &[KnownCenter], points: &[KnownPoint]) -> (Problem, State) {
    let mark = |photograph: usize, at_px: DVec2| Mark { photograph, at_px, sigma_px: MARK_SIGMA_PX };
    let mut marks: Vec<Mark> = its.marks.iter().map(|tie| mark(tie.photograph as usize, tie.at_px)).collect();
    let mut marks_of = Vec::with_capacity(its.points.len() + points.len());
    let mut begin = 0;
    for point in 0..its.points.len() {
        let count = its.marks[begin..].iter().take_while(|mark| mark.point as usize == point).count();
        marks_of.push(begin..begin + count);
        begin += count;
    }
    let mut anchors = Vec::with_capacity(points.len());
    for point in points {
        anchors.push(Anchor { of: marks_of.len(), at_m: point.at_m, weight: point.weight });
        marks_of.push(marks.len()..marks.len() + point.marks.len());
        marks.extend(point.marks.iter().map(|(photograph, at_px)| mark(*photograph, *at_px)));
    }
    let station = |rotation, center| Station { rotation, center };
    let stations: Vec<Station> = its
        .posed
        .iter()
        .map(|posed| station(posed.cam_from_world.rotation, posed.cam_from_world.center()))
        .collect();
    let at: Vec<DVec3> = stations.iter().map(|station| station.center).collect();
    let problem = Problem {
        lens_of: its.posed.iter().map(|posed| posed.lens).collect(),
        marks,
        marks_of,
        centers: anchored_centers(&at, centers),
        points: anchors,
        lens_equations: its
            .lenses
            .iter()
            .enumerate()
            .flat_map(|(i, lens)| LensEquation::of(i, lens))
            .collect(),
        unknown_of: order::ranks(&at).into_iter().map(|rank| POSE * rank).collect(),
    };
    let ties = its.points.iter().map(|point| point.position);
    let points = ties.chain(points.iter().map(|point| point.seen_m)).collect();
    (problem, State { stations, lenses: its.lenses.clone(), points })
}

/// What is known of the centres. Each also stays, very loosely, where it is: photographs alone tell no place and no scale.
fn anchored_centers(at: &[DVec3], known: &[KnownCenter]) -> Vec<Anchor> {
    let middle = at.iter().sum::<DVec3>() / at.len() as f64;
    let extent_m = at.iter().map(|at| at.distance(middle)).fold(f64::MIN_POSITIVE, f64::max);
    let loose = DVec3::splat(extent_m.powi(-2));
    let stay = at.iter().enumerate().map(|(of, at)| Anchor { of, at_m: *at, weight: loose });
    let known = known.iter().map(|its| Anchor { of: its.photograph, at_m: its.at_m, weight: its.weight });
    stay.chain(known).collect()
}

/// The standard deviation of the first `count` marks, pixels.
fn spread_px(problem: &Problem, state: &State, count: usize) -> f64 {
    let mut off_px = Vec::with_capacity(count);
    for (marks, point) in problem.marks_of.iter().zip(&state.points) {
        for mark in &problem.marks[marks.start.min(count)..marks.end.min(count)] {
            let lens = &state.lenses[problem.lens_of[mark.photograph]];
            let seen = project(&state.stations[mark.photograph], lens, *point);
            off_px.extend(seen.map(|seen| seen.distance(mark.at_px)));
        }
    }
    let middle = off_px.len() / 2;
    if off_px.is_empty() {
        return MARK_SIGMA_PX;
    }
    (SIGMA_PER_MEDIAN * *off_px.select_nth_unstable_by(middle, f64::total_cmp).1).max(TIE_SIGMA_PX)
}

/// Steps from a state until nothing gets better.
fn solve(problem: &Problem, mut state: State, first: &[usize]) -> State {
    let mut cost = problem.cost(&state);
    let (mut damping, mut is_settled) = (DAMPING, false);
    for _ in 0..STEPS_MAX {
        let better = equations::step(problem, &state, first, damping)
            .map(|next| (problem.cost(&next), next))
            .filter(|(next_cost, _)| *next_cost < cost);
        let Some((next_cost, next)) = better else {
            // Rounding makes each state a little worse than the best one.
            damping *= 10.0;
            if is_settled || damping > DAMPING_MAX {
                break;
            }
            continue;
        };
        is_settled = cost - next_cost < CHANGE_MIN * cost;
        (state, cost) = (next, next_cost);
        if is_settled && damping <= DAMPING_END {
            break;
        }
        damping = (damping / 10.0).max(DAMPING_END);
    }
    state
}
