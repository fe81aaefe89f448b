//! Nearest points: a k-d tree that is a reordered list, built and asked in parallel.

use glam::Vec3;

/// Ranges no longer are searched one by one.
const LEAF: usize = 8;
/// Ranges no longer are built by one thread.
const GRAIN: usize = 1 << 14;

/// Points with their indices, ordered so that the middle of every range splits it along one axis, taking
/// turns.
pub(super) struct Tree(Vec<(Vec3, u32)>);

impl Tree {
    /// Fewer than 2³² points, finite.
    pub(super) fn new(points: &[Vec3]) -> Self {
        let mut points: Vec<(Vec3, u32)> = points.iter().copied().zip(0..).collect();
        split(&mut points, 0);
        Self(points)
    }

    /// Squared distances to the `K` nearest points and their indices, ascending; infinite where there
    /// are fewer.
    pub(super) fn nearest<const K: usize>(&self, query: Vec3) -> [(f32, u32); K] {
        let mut best = [(f32::INFINITY, u32::MAX); K];
        search(&self.0, query, 0, &mut best);
        best
    }

    /// Whether a point lies nearer than the root of `reach2`.
    pub(super) fn is_any_within(&self, query: Vec3, reach2: f32) -> bool {
        is_any_within(&self.0, query, 0, reach2)
    }
}

fn split(points: &mut [(Vec3, u32)], axis: usize) {
    if points.len() <= LEAF {
        return;
    }
    let middle = points.len() / 2;
    let (below, _, above) = points.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]));
    let next = (axis + 1) % 3;
    if below.len() > GRAIN {
        rayon::join(|| split(below, next), || split(above, next));
    } else {
        split(below, next);
        split(above, next);
    }
}

fn search<const K: usize>(points: &[(Vec3, u32)], query: Vec3, axis: usize, best: &mut [(f32, u32); K]) {
    if points.len() <= LEAF {
        points.iter().for_each(|point| insert(best, point, query));
        return;
    }
    let middle = points.len() / 2;
    insert(best, &points[middle], query);
    let beyond = query[axis] - points[middle].0[axis];
    let (below, above) = (&points[..middle], &points[middle + 1..]);
    let (near, far) = if beyond < 0.0 { (below, above) } else { (above, below) };
    let next = (axis + 1) % 3;
    search(near, query, next, best);
    if beyond * beyond < best[K - 1].0 {
        search(far, query, next, best);
    }
}

fn is_any_within(points: &[(Vec3, u32)], query: Vec3, axis: usize, reach2: f32) -> bool {
    if points.len() <= LEAF {
        return points.iter().any(|point| point.0.distance_squared(query) < reach2);
    }
    let middle = points.len() / 2;
    if points[middle].0.distance_squared(query) < reach2 {
        return true;
    }
    let beyond = query[axis] - points[middle].0[axis];
    let (below, above) = (&points[..middle], &points[middle + 1..]);
    let (near, far) = if beyond < 0.0 { (below, above) } else { (above, below) };
    let next = (axis + 1) % 3;
    is_any_within(near, query, next, reach2)
        || (beyond * beyond < reach2 && is_any_within(far, query, next, reach2))
}

#[inline]
fn insert<const K: usize>(best: &mut [(f32, u32); K], point: &(Vec3, u32), query: Vec3) {
    let distance = point.0.distance_squared(query);
    if distance < best[K - 1].0 {
        let place = best.partition_point(|b| b.0 <= distance);
        best[place..].rotate_right(1);
        best[place] = (distance, point.1);
    }
}
