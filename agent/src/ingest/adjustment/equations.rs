//! The normal equations of a step, with the points eliminated (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000,
//! section 6.1). The derivatives are computed again for the step of the points instead of being kept: memory is scarcer
//! than time.

use glam::{DMat3, DVec2, DVec3};

use super::super::lens::Lens;
use super::envelope::Envelope;
use super::problem::{Anchor, Problem, State};
use super::projection::{Derivatives, LENS, POSE, differentiate};

/// A mark with its derivatives.
struct Seen {
    off_px: DVec2,
    weight: f64,
    derivatives: Derivatives,
    /// First unknowns of the pose and of the lens.
    starts: [usize; 2],
}

/// How a point hangs on some unknowns that follow each other: products of the derivatives.
struct Link {
    start: usize,
    count: usize,
    rows: [DVec3; LENS],
}

/// The equations of a point, and what it hangs on.
struct PointEquations {
    /// The inverse of the matrix.
    inverse: DMat3,
    right: DVec3,
    seen: Vec<Seen>,
    links: Vec<Link>,
}

/// A step of all unknowns. `damping` is Marquardt's factor on the diagonal. `None` if the equations have no solution.
pub(super) fn step(problem: &Problem, state: &State, first: &[usize], damping: f64) -> Option<State> {
    let unknowns = problem.unknowns(state);
    let mut matrix = Envelope::new(first.to_vec());
    let (mut right, mut diagonal) = (vec![0.0; unknowns], vec![0.0; unknowns]);
    each_point(problem, state, damping, |_, its| {
        its.seen.iter().for_each(|seen| seen.add(&mut matrix, &mut right, &mut diagonal));
        its.eliminate(&mut matrix, &mut right);
    });
    for anchor in &problem.centers {
        let off = state.stations[anchor.of].center - anchor.at_m;
        for axis in 0..3 {
            let unknown = problem.unknown_of[anchor.of] + 3 + axis;
            let weight = anchor.weight[axis];
            *matrix.diagonal(unknown) += weight;
            diagonal[unknown] += weight;
            right[unknown] -= weight * off[axis];
        }
    }
    for equation in &problem.lens_equations {
        let start = problem.unknown_of_lens(equation.lens);
        let off = equation.off(&state.lenses[equation.lens]);
        for i in 0..LENS {
            let weighted = equation.weight * equation.factors[i];
            let row = matrix.row_from(start + i, start);
            row.iter_mut().zip(equation.factors).for_each(|(value, factor)| *value += weighted * factor);
            diagonal[start + i] += weighted * equation.factors[i];
            right[start + i] -= weighted * off;
        }
    }
    for (unknown, value) in diagonal.iter().enumerate() {
        *matrix.diagonal(unknown) += damping * value;
    }
    matrix.factor()?.solve(&mut right);
    stepped(problem, state, damping, &right)
}

/// The state after a step of poses and lenses, and the step of the points that follows from it.
fn stepped(problem: &Problem, state: &State, damping: f64, step: &[f64]) -> Option<State> {
    let mut next = state.clone();
    for (station, start) in next.stations.iter_mut().zip(&problem.unknown_of) {
        *station = station.stepped(&step[*start..*start + POSE]);
    }
    for (i, lens) in next.lenses.iter_mut().enumerate() {
        let start = problem.unknown_of_lens(i);
        let mut parameters = lens.parameters();
        parameters.iter_mut().zip(&step[start..]).for_each(|(its, step)| *its += step);
        *lens = Lens::of_parameters(lens.size_px, parameters)?;
    }
    let points = &mut next.points;
    each_point(problem, state, damping, |i, its| {
        let mut right = its.right;
        for link in &its.links {
            let rows = &link.rows[..link.count];
            right -= rows.iter().zip(&step[link.start..]).map(|(row, step)| *row * *step).sum::<DVec3>();
        }
        points[i] += its.inverse * right;
    });
    Some(next)
}

/// Computes the equations of all points that two marks or more determine.
fn each_point(problem: &Problem, state: &State, damping: f64, mut with: impl FnMut(usize, &PointEquations)) {
    let mut anchors = problem.points.iter().peekable();
    for point in 0..state.points.len() {
        let anchor = anchors.next_if(|anchor| anchor.of == point);
        if let Some(its) = PointEquations::of(problem, state, point, anchor, damping) {
            with(point, &its);
        }
    }
}

impl PointEquations {
    fn of(
        problem: &Problem,
        state: &State,
        point: usize,
        anchor: Option<&Anchor>,
        damping: f64,
    ) -> Option<Self> {
        let at = state.points[point];
        let marks = &problem.marks[problem.marks_of[point].clone()];
        let mut seen = Vec::with_capacity(marks.len());
        let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for mark in marks {
            let lens = problem.lens_of[mark.photograph];
            let station = &state.stations[mark.photograph];
            let Some((at_px, derivatives)) = differentiate(station, &state.lenses[lens], at) else {
                continue;
            };
            let off_px = at_px - mark.at_px;
            let weight = mark.weight(off_px);
            for axis in 0..2 {
                let row = derivatives.point[axis];
                matrix += outer(row) * weight;
                right -= row * (weight * off_px[axis]);
            }
            let starts = [problem.unknown_of[mark.photograph], problem.unknown_of_lens(lens)];
            seen.push(Seen { off_px, weight, derivatives, starts });
        }
        if seen.len() < 2 {
            return None;
        }
        if let Some(anchor) = anchor {
            matrix += DMat3::from_diagonal(anchor.weight);
            right -= anchor.weight * (at - anchor.at_m);
        }
        matrix += DMat3::from_diagonal(matrix.diagonal() * damping);
        let inverse = matrix.inverse();
        let links = links(&seen);
        (matrix.determinant() > 0.0 && inverse.is_finite()).then_some(Self { inverse, right, seen, links })
    }

    /// Takes from the equations of poses and lenses what the point, free to move, makes good.
    fn eliminate(&self, matrix: &mut Envelope, right: &mut [f64]) {
        let moved = self.inverse * self.right;
        for a in &self.links {
            for i in 0..a.count {
                let row = a.start + i;
                right[row] -= a.rows[i].dot(moved);
                let pulled = self.inverse * a.rows[i];
                for b in self.links.iter().filter(|b| b.start <= a.start) {
                    let values = matrix.row_from(row, b.start);
                    values
                        .iter_mut()
                        .zip(&b.rows[..b.count])
                        .for_each(|(value, other)| *value -= pulled.dot(*other));
                }
            }
        }
    }
}

/// What a point hangs on; a pose or a lens that has several marks of it only once.
fn links(seen: &[Seen]) -> Vec<Link> {
    let mut links: Vec<Link> = Vec::with_capacity(seen.len() + 1);
    for its in seen {
        for (part, (start, count)) in its.starts.into_iter().zip([POSE, LENS]).enumerate() {
            let at = links.iter().position(|link| link.start == start).unwrap_or_else(|| {
                links.push(Link { start, count, rows: [DVec3::ZERO; LENS] });
                links.len() - 1
            });
            for (axis, unknowns) in its.derivatives.unknowns.iter().enumerate() {
                let by_point = its.derivatives.point[axis] * its.weight;
                let unknowns = &unknowns[part * POSE..];
                links[at].rows[..count].iter_mut().zip(unknowns).for_each(|(row, by)| *row += by_point * *by);
            }
        }
    }
    links
}

impl Seen {
    /// Adds what the mark tells about its pose and its lens if the point stays.
    fn add(&self, matrix: &mut Envelope, right: &mut [f64], diagonal: &mut [f64]) {
        let [x, y] = &self.derivatives.unknowns;
        let unknown = |i: usize| if i < POSE { self.starts[0] + i } else { self.starts[1] + i - POSE };
        for i in 0..POSE + LENS {
            let [by_x, by_y] = [x[i] * self.weight, y[i] * self.weight];
            let row = unknown(i);
            right[row] -= by_x * self.off_px.x + by_y * self.off_px.y;
            diagonal[row] += by_x * x[i] + by_y * y[i];
            for (start, part) in [(self.starts[0], 0..POSE), (self.starts[1], POSE..POSE + LENS)] {
                if start > row {
                    continue;
                }
                // A row ends in the diagonal.
                let values = matrix.row_from(row, start).iter_mut();
                values.zip(part).for_each(|(value, j)| *value += by_x * x[j] + by_y * y[j]);
            }
        }
    }
}

fn outer(row: DVec3) -> DMat3 {
    DMat3::from_cols(row * row.x, row * row.y, row * row.z)
}
