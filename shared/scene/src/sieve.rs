//! Collects sparse points within a limit of memory.

use crate::SparsePoint;

/// What the allocator takes for a track besides its entries, bytes.
const TRACK_BYTES: usize = 32;

/// Keeps all points while there is room. After that, keeps every second one, then every fourth, and so on.
pub(crate) struct Sieve {
    points: Vec<SparsePoint>,
    stride: usize,
    seen: usize,
    bytes: usize,
    bytes_max: usize,
}

impl Sieve {
    /// No points yet; those to come take at most about `bytes_max`, but one is always kept.
    pub(crate) fn new(bytes_max: usize) -> Self {
        Self { points: Vec::new(), stride: 1, seen: 0, bytes: 0, bytes_max }
    }

    /// Takes the next point, or leaves it out.
    pub(crate) fn add(&mut self, point: SparsePoint) {
        let place = self.seen;
        self.seen += 1;
        if !place.is_multiple_of(self.stride) {
            return;
        }
        self.bytes += bytes(&point);
        self.points.push(point);
        while self.bytes > self.bytes_max && self.points.len() > 1 {
            self.stride *= 2;
            let mut place = 0;
            self.points.retain(|_| {
                place += 1;
                place % 2 == 1
            });
            self.bytes = self.points.iter().map(bytes).sum();
        }
    }

    /// The points that were kept, and of how many in a row one was.
    pub(crate) fn end(self) -> (Vec<SparsePoint>, usize) {
        (self.points, self.stride)
    }
}

/// Memory of a point. A growing list has up to twice the room that it needs.
fn bytes(point: &SparsePoint) -> usize {
    let track = if point.views.is_empty() { 0 } else { TRACK_BYTES };
    2 * size_of::<SparsePoint>() + track + size_of_val(&point.views[..])
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn kept(count: usize, bytes_max: usize) -> (Vec<usize>, usize) {
        let mut sieve = Sieve::new(bytes_max);
        for x in 0..count {
            sieve.add(SparsePoint { position: DVec3::splat(x as f64), rgb: [0; 3], views: vec![1, 2] });
        }
        let (points, stride) = sieve.end();
        (points.iter().map(|point| point.position.x as usize).collect(), stride)
    }

    #[test]
    fn as_many_evenly_spaced_points_are_kept_as_there_is_room_for() {
        let of_one = 2 * size_of::<SparsePoint>() + TRACK_BYTES + 8;
        assert_eq!(kept(10, 10 * of_one), ((0..10).collect(), 1));
        assert_eq!(kept(11, 10 * of_one), (vec![0, 2, 4, 6, 8, 10], 2));
        assert_eq!(kept(1000, 10 * of_one), ((0..1000).step_by(128).collect(), 128));
        assert_eq!(kept(5, 0), (vec![0], 8));
        assert_eq!(kept(0, 0), (vec![], 1));
    }
}
