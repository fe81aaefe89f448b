//! Nearest points: a k-d tree, stored as a reordered list of points.
//!
//! No crate is used, because the bits of a training depend on the order of points at equal distances, which crates do
//! not specify. The crate `kiddo` would also bring about 25 packages and a build script, and its mutable tree panics on
//! many equal points.

use std::cmp::Ordering;
use std::ops::{Add, Mul, Sub};

/// A range is split between two threads if its lower half has more points than this.
const GRAIN: usize = 1 << 14;

/// A coordinate: `f32` or `f64`.
pub trait Coordinate:
    Copy + PartialOrd + Send + Sync + Sub<Output = Self> + Mul<Output = Self> + Add<Output = Self>
{
    /// Infinity, which is larger than every distance.
    const INFINITY: Self;
    /// 0.
    const ZERO: Self;

    /// Compares in a total order of all values, NaN included.
    fn total_order(&self, other: &Self) -> Ordering;
}

macro_rules! coordinates {
    ($($float:ident)*) => {
        $(impl Coordinate for $float {
            const INFINITY: Self = $float::INFINITY;
            const ZERO: Self = 0.0;

            #[inline]
            fn total_order(&self, other: &Self) -> Ordering {
                self.total_cmp(other)
            }
        })*
    };
}
coordinates!(f32 f64);

/// A point that a search found, and its distance from the query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Near<S> {
    /// Square of the distance.
    pub distance_squared: S,
    /// Index of the point in the list that the tree was built from.
    pub index: u32,
}

/// A k-d tree of points with their indices. The middle point of a range splits the range along one axis; the axes
/// alternate. Ranges of at most `leaf` points are not split.
#[derive(Clone, Debug)]
pub struct Tree<S> {
    points: Vec<([S; 3], u32)>,
    leaf: usize,
}

impl<S: Coordinate> Tree<S> {
    /// Builds a tree of fewer than 2³² finite points. Ranges of at most `leaf` points (at least 1) are searched point
    /// by point. The same points and `leaf` always give the same order of points at equal distances.
    pub fn new(points: &[[S; 3]], leaf: usize) -> Self {
        Self::built(points, leaf, usize::MAX)
    }

    /// Builds the same tree as [`Self::new`], with the threads of the current rayon pool.
    pub fn new_parallel(points: &[[S; 3]], leaf: usize) -> Self {
        Self::built(points, leaf, GRAIN)
    }

    fn built(points: &[[S; 3]], leaf: usize, grain: usize) -> Self {
        let leaf = leaf.max(1);
        let mut points: Vec<([S; 3], u32)> = points.iter().copied().zip(0..).collect();
        split(&mut points, 0, leaf, grain);
        Self { points, leaf }
    }

    /// The `K` points nearest to `query`, the nearest first. If the tree has fewer points, the remaining entries are
    /// infinitely far and have the index `u32::MAX`.
    pub fn nearest<const K: usize>(&self, query: [S; 3]) -> [Near<S>; K] {
        let mut best = [Near { distance_squared: S::INFINITY, index: u32::MAX }; K];
        search(&self.points, self.leaf, &query, 0, &mut best);
        best
    }

    /// Whether a point of the tree lies nearer to `query` than the square root of `reach_squared`.
    pub fn is_any_within(&self, query: [S; 3], reach_squared: S) -> bool {
        is_any_within(&self.points, self.leaf, &query, 0, reach_squared)
    }
}

#[inline]
fn distance_squared<S: Coordinate>(a: &[S; 3], b: &[S; 3]) -> S {
    let [x, y, z] = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    x * x + y * y + z * z
}

fn split<S: Coordinate>(points: &mut [([S; 3], u32)], axis: usize, leaf: usize, grain: usize) {
    if points.len() <= leaf {
        return;
    }
    let middle = points.len() / 2;
    let (below, _, above) = points.select_nth_unstable_by(middle, |a, b| a.0[axis].total_order(&b.0[axis]));
    let next = (axis + 1) % 3;
    if below.len() > grain {
        rayon::join(|| split(below, next, leaf, grain), || split(above, next, leaf, grain));
    } else {
        split(below, next, leaf, grain);
        split(above, next, leaf, grain);
    }
}

fn search<S: Coordinate, const K: usize>(
    points: &[([S; 3], u32)],
    leaf: usize,
    query: &[S; 3],
    axis: usize,
    best: &mut [Near<S>; K],
) {
    if points.len() <= leaf {
        points.iter().for_each(|point| insert(best, point, query));
        return;
    }
    let middle = points.len() / 2;
    insert(best, &points[middle], query);
    let beyond = query[axis] - points[middle].0[axis];
    let (below, above) = (&points[..middle], &points[middle + 1..]);
    let (near, far) = if beyond < S::ZERO { (below, above) } else { (above, below) };
    let next = (axis + 1) % 3;
    search(near, leaf, query, next, best);
    if beyond * beyond < best[K - 1].distance_squared {
        search(far, leaf, query, next, best);
    }
}

fn is_any_within<S: Coordinate>(
    points: &[([S; 3], u32)],
    leaf: usize,
    query: &[S; 3],
    axis: usize,
    reach_squared: S,
) -> bool {
    if points.len() <= leaf {
        return points.iter().any(|point| distance_squared(&point.0, query) < reach_squared);
    }
    let middle = points.len() / 2;
    if distance_squared(&points[middle].0, query) < reach_squared {
        return true;
    }
    let beyond = query[axis] - points[middle].0[axis];
    let (below, above) = (&points[..middle], &points[middle + 1..]);
    let (near, far) = if beyond < S::ZERO { (below, above) } else { (above, below) };
    let next = (axis + 1) % 3;
    is_any_within(near, leaf, query, next, reach_squared)
        || (beyond * beyond < reach_squared && is_any_within(far, leaf, query, next, reach_squared))
}

/// Inserts a point into `best`, the nearest points so far, if it is near enough. Of points at equal distances, the one
/// that was found first stays first.
#[inline]
fn insert<S: Coordinate, const K: usize>(
    best: &mut [Near<S>; K],
    (point, index): &([S; 3], u32),
    query: &[S; 3],
) {
    let distance_squared = distance_squared(point, query);
    if distance_squared < best[K - 1].distance_squared {
        let place = best.partition_point(|b| b.distance_squared <= distance_squared);
        best[place..].rotate_right(1);
        best[place] = Near { distance_squared, index: *index };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Random};

    #[test]
    fn the_tree_finds_what_comparing_all_finds() {
        let mut random = Random::new(1, Purpose::Test, 0, 0);
        let mut points: Vec<[f64; 3]> =
            (0..500).map(|_| [0, 1, 2].map(|_| f64::from(random.normal()))).collect();
        points.extend_from_within(..20);
        for leaf in [1, 8] {
            let tree = Tree::new(&points, leaf);
            for query in &points {
                let mut all: Vec<f64> = points.iter().map(|p| distance_squared(p, query)).collect();
                all.sort_unstable_by(f64::total_cmp);
                let found = tree.nearest::<5>(*query);
                assert_eq!(found.map(|near| near.distance_squared), all[..5]);
                assert_eq!(found.map(|near| distance_squared(&points[near.index as usize], query)), all[..5]);
                assert!(tree.is_any_within(*query, f64::MIN_POSITIVE));
            }
            assert!(!tree.is_any_within([100.0; 3], 1.0));
        }
        let alone = Tree::new(&points[..1], 1).nearest::<2>(points[0]);
        assert_eq!(alone.map(|near| near.distance_squared), [0.0, f64::INFINITY]);
        assert_eq!(alone.map(|near| near.index), [0, u32::MAX]);
    }

    #[test]
    fn many_equal_points_are_found_and_threads_change_nothing() {
        let points: Vec<[f32; 3]> = (0..3 * GRAIN).map(|i| [(i % 7) as f32, 1.0, 2.0]).collect();
        let tree = Tree::new(&points, 8);
        assert_eq!(tree.points, Tree::new_parallel(&points, 8).points);
        assert_eq!(tree.nearest::<4>([3.0, 1.0, 2.0]).map(|near| near.distance_squared), [0.0; 4]);
        assert!(tree.is_any_within([6.4, 1.0, 2.0], 0.2));
        assert!(!tree.is_any_within([6.4, 1.0, 2.0], 0.1));
    }
}
