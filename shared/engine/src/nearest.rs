//! Distances to nearest neighbours: a k-d tree that is nothing but a reordered list of points. (The
//! k-d tree crates bring dozens of packages with them, for the one question that is asked once.)

/// Points ordered so that the middle of every range splits it along one axis, taking turns.
pub(crate) struct Tree(Vec<[f64; 3]>);

impl Tree {
    pub(crate) fn new(points: &[[f64; 3]]) -> Self {
        let mut points = points.to_vec();
        split(&mut points, 0);
        Self(points)
    }

    /// The `K` points nearest to `query`, the nearest first; infinitely far where there are fewer.
    pub(crate) fn nearest<const K: usize>(&self, query: &[f64; 3]) -> [Near; K] {
        let mut best = [Near { distance_squared: f64::INFINITY, point: [f64::INFINITY; 3] }; K];
        search(&self.0, query, 0, &mut best);
        best
    }
}

/// A point, and how far it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Near {
    pub(crate) distance_squared: f64,
    pub(crate) point: [f64; 3],
}

fn split(points: &mut [[f64; 3]], axis: usize) {
    if points.len() < 2 {
        return;
    }
    let middle = points.len() / 2;
    let (below, _, above) = points.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
    split(below, (axis + 1) % 3);
    split(above, (axis + 1) % 3);
}

fn search<const K: usize>(points: &[[f64; 3]], query: &[f64; 3], axis: usize, best: &mut [Near; K]) {
    let middle = points.len() / 2;
    let Some(point) = points.get(middle) else { return };
    let distance_squared = (0..3).map(|k| (point[k] - query[k]).powi(2)).sum();
    insert(best, Near { distance_squared, point: *point });
    let beyond = query[axis] - point[axis];
    let (below, above) = (&points[..middle], &points[middle + 1..]);
    let (near, far) = if beyond < 0.0 { (below, above) } else { (above, below) };
    search(near, query, (axis + 1) % 3, best);
    if beyond * beyond < best[K - 1].distance_squared {
        search(far, query, (axis + 1) % 3, best);
    }
}

fn insert<const K: usize>(best: &mut [Near; K], near: Near) {
    let place = best.partition_point(|b| b.distance_squared <= near.distance_squared);
    if place < K {
        best[place..].rotate_right(1);
        best[place] = near;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Random};

    #[test]
    fn the_tree_finds_what_comparing_all_finds() {
        let mut random = Random::new(1, Purpose::Birth, 0, 0);
        let mut points: Vec<[f64; 3]> =
            (0..500).map(|_| [0, 1, 2].map(|_| f64::from(random.normal()))).collect();
        points.extend_from_within(..20);
        let tree = Tree::new(&points);
        for query in &points {
            let mut all: Vec<f64> =
                points.iter().map(|p| (0..3).map(|k| (p[k] - query[k]).powi(2)).sum()).collect();
            all.sort_unstable_by(f64::total_cmp);
            assert_eq!(tree.nearest::<5>(query).map(|near| near.distance_squared), all[..5]);
        }
        let alone = Tree::new(&points[..1]).nearest::<2>(&points[0]);
        assert_eq!(alone.map(|near| near.distance_squared), [0.0, f64::INFINITY]);
        assert_eq!(alone[0].point, points[0]);
    }
}
