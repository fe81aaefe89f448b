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

    /// Squared distances from `query` to its `K` nearest points, ascending; infinite where there are fewer.
    pub(crate) fn nearest_squared<const K: usize>(&self, query: &[f64; 3]) -> [f64; K] {
        let mut best = [f64::INFINITY; K];
        search(&self.0, query, 0, &mut best);
        best
    }
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

fn search<const K: usize>(points: &[[f64; 3]], query: &[f64; 3], axis: usize, best: &mut [f64; K]) {
    let middle = points.len() / 2;
    let Some(point) = points.get(middle) else { return };
    insert(best, (0..3).map(|k| (point[k] - query[k]).powi(2)).sum());
    let beyond = query[axis] - point[axis];
    let (below, above) = (&points[..middle], &points[middle + 1..]);
    let (near, far) = if beyond < 0.0 { (below, above) } else { (above, below) };
    search(near, query, (axis + 1) % 3, best);
    if beyond * beyond < best[K - 1] {
        search(far, query, (axis + 1) % 3, best);
    }
}

fn insert<const K: usize>(best: &mut [f64; K], distance: f64) {
    let place = best.partition_point(|b| *b <= distance);
    if place < K {
        best[place..].rotate_right(1);
        best[place] = distance;
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
            assert_eq!(tree.nearest_squared::<5>(query), all[..5]);
        }
        assert_eq!(Tree::new(&points[..1]).nearest_squared::<2>(&points[0]), [0.0, f64::INFINITY]);
    }
}
