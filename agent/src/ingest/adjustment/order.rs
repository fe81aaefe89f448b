//! The order of photographs in the equations: along the longest side of the flight, so that those that share ground are near
//! each other, and most of the matrix stays empty.

use glam::DVec3;

use super::problem::{Problem, State};
use super::projection::POSE;

/// The place of each photograph in the order.
pub(super) fn ranks(centers: &[DVec3]) -> Vec<usize> {
    let smallest = centers.iter().copied().reduce(DVec3::min).unwrap_or_default();
    let largest = centers.iter().copied().reduce(DVec3::max).unwrap_or_default();
    let along = (largest - smallest).max_position();
    let mut order: Vec<usize> = (0..centers.len()).collect();
    order.sort_by(|a, b| centers[*a][along].total_cmp(&centers[*b][along]));
    let mut ranks = vec![0; order.len()];
    order.into_iter().enumerate().for_each(|(rank, photograph)| ranks[photograph] = rank);
    ranks
}

/// The first unknown that shares a point or a lens with each unknown.
pub(super) fn first_columns(problem: &Problem, state: &State) -> Vec<usize> {
    let mut first: Vec<usize> = (0..problem.lens_of.len()).map(|rank| POSE * rank).collect();
    for marks in &problem.marks_of {
        let starts = || problem.marks[marks.clone()].iter().map(|mark| problem.unknown_of[mark.photograph]);
        let smallest = starts().min().unwrap_or_default();
        starts().for_each(|start| first[start / POSE] = first[start / POSE].min(smallest));
    }
    let of_poses = first.into_iter().flat_map(|first| [first; POSE]);
    // Each lens is that of photographs everywhere.
    let of_lenses = problem.unknown_of_lens(0)..problem.unknowns(state);
    of_poses.chain(of_lenses.map(|_| 0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_follow_each_other_along_the_longest_side() {
        let centers = [[0.0, 90.0, 5.0], [10.0, -20.0, 5.0], [5.0, 30.0, 8.0]].map(DVec3::from);
        assert_eq!(ranks(&centers), [2, 0, 1]);
        assert!(ranks(&[]).is_empty());
    }
}
