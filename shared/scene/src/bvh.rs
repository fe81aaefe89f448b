//! A bounding volume hierarchy over triangles, with four boxes per node and four triangles per leaf. So
//! each step of a traversal takes a handful of four-wide vector operations.
//!
//! Rays are traced in bundles of neighbours: the viewing rays of a pixel, or the shadow rays from
//! neighbouring points to the sun. The rays of a bundle meet nearly the same boxes. So a bundle traverses
//! the tree once, as a beam that encloses its rays, and only triangles are tested ray by ray.

mod build;
mod node;

use glam::{Vec3, Vec4};

use node::{LEAF, Lanes, Leaf, Node, Tree};

/// Largest number of triangles in a hierarchy.
pub const TRIANGLES_MAX: usize = build::TRIANGLES_MAX;
/// Entries of the traversal stack. At each level of the tree at most three children wait on it. It has
/// room for [`build::MEDIAN_DEPTH`] levels and for 13 more; splits into four equal parts divide
/// [`TRIANGLES_MAX`] triangles into leaves within 13 levels.
const STACK: usize = 80;
/// How far outside a triangle a ray may pass and still hit it, in barycentric coordinates. This closes the
/// cracks that rounding opens between neighbouring triangles.
const EDGE_SLACK: f32 = 1e-6;
/// Factor on the `t` at which a beam leaves a box. It exceeds the rounding error, so that no beam misses a
/// box that its rays meet.
const BOX_SLACK: f32 = 1.0 + 1e-6;
/// A coordinate far beyond any surface, world units.
const FAR: f32 = 1e30;

/// The ray `origin + t · direction` for `t_min < t < t_max`.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// World position at `t = 0`.
    pub origin: Vec3,
    /// The direction, of any non-zero length.
    pub direction: Vec3,
    /// Hits must lie beyond this `t`.
    pub t_min: f32,
    /// Hits must lie before this `t`.
    pub t_max: f32,
}

/// Where a ray met a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// The hit is at `origin + t · direction` of the ray.
    pub t: f32,
    /// Index into the triangles that the hierarchy was built from.
    pub triangle: u32,
    /// Barycentric weights of the triangle's second and third corner.
    pub barycentric: [f32; 2],
}

/// A bounding volume hierarchy over triangles, which finds the triangles that rays hit.
#[derive(Debug)]
pub struct Bvh {
    tree: Tree,
}

/// A ray with each coordinate repeated in all four SIMD lanes.
#[derive(Clone, Copy)]
struct WideRay {
    origin: Lanes,
    direction: Lanes,
    t_min: Vec4,
}

impl WideRay {
    #[inline]
    fn new(ray: &Ray) -> Self {
        let splat = |v: Vec3| v.to_array().map(Vec4::splat);
        Self { origin: splat(ray.origin), direction: splat(ray.direction), t_min: Vec4::splat(ray.t_min) }
    }
}

/// Encloses all rays of a bundle. For each axis it has the inverses of the smallest and of the largest
/// direction, and the two extreme origins: `enter_from` gives the earliest entry into a box, `leave_from`
/// the latest exit.
struct Beam {
    inverses: [Lanes; 2],
    enter_from: Lanes,
    leave_from: Lanes,
    /// For each axis, the index in [`Node::bounds`] of the bound that the rays meet first: 0 for the
    /// minimum, 1 for the maximum.
    first: [usize; 3],
    t_min: Vec4,
}

impl Beam {
    #[inline]
    fn new(rays: &[Ray]) -> Self {
        let bounds = |of: fn(&Ray) -> Vec3| {
            let all = rays.iter().map(of);
            all.fold((Vec3::MAX, Vec3::MIN), |(low, high), v| (low.min(v), high.max(v)))
        };
        let (origin, direction) = (bounds(|r| r.origin), bounds(|r| r.direction));
        let mut beam = Self {
            inverses: [[Vec4::ONE; 3]; 2],
            enter_from: [Vec4::splat(FAR); 3],
            leave_from: [Vec4::splat(-FAR); 3],
            first: [0; 3],
            t_min: Vec4::splat(rays.iter().map(|r| r.t_min).fold(f32::MAX, f32::min)),
        };
        for axis in 0..3 {
            let (low, high) = (direction.0[axis], direction.1[axis]);
            if low * high <= 0.0 && low < high {
                // The rays do not all go the same way along this axis, so the axis excludes no box.
                continue;
            }
            // A direction near zero gets a large but finite inverse, so that no box test multiplies zero
            // by infinity.
            let inverse = |x: f32| Vec4::splat(if x.abs() < 1e-20 { 1e20 } else { 1.0 / x });
            beam.inverses[0][axis] = inverse(low);
            beam.inverses[1][axis] = inverse(high);
            let backwards = high < -1e-20;
            beam.first[axis] = usize::from(backwards);
            let ends = [origin.1[axis], origin.0[axis]].map(Vec4::splat);
            beam.enter_from[axis] = ends[usize::from(backwards)];
            beam.leave_from[axis] = ends[usize::from(!backwards)];
        }
        beam
    }
}

impl Node {
    /// The `t` at which the beam enters each box, and a bit mask of the boxes that the beam meets before
    /// `t_max`.
    #[inline]
    fn enter(&self, beam: &Beam, t_max: f32) -> (Vec4, u32) {
        let mut enter = beam.t_min;
        let mut leave = Vec4::splat(t_max);
        for axis in 0..3 {
            let near = self.bounds[beam.first[axis]][axis] - beam.enter_from[axis];
            let far = self.bounds[1 - beam.first[axis]][axis] - beam.leave_from[axis];
            let [a, b] = [beam.inverses[0][axis], beam.inverses[1][axis]];
            enter = enter.max((near * a).min(near * b));
            leave = leave.min((far * a).max(far * b) * BOX_SLACK);
        }
        (enter, enter.cmple(leave).bitmask())
    }
}

impl Leaf {
    /// Intersects a ray with the leaf's triangles, from either side (Möller and Trumbore 1997). Returns
    /// the weights of the second and third corner, `t`, and a bit mask of the triangles that the ray meets
    /// before `t_max`.
    #[inline]
    fn intersect(&self, ray: &WideRay, t_max: f32) -> (Vec4, Vec4, Vec4, u32) {
        let across = cross(&ray.direction, &self.edges[1]);
        let scale = Vec4::ONE / dot(&self.edges[0], &across);
        let from_corner = [0, 1, 2].map(|axis| ray.origin[axis] - self.corner[axis]);
        let u = dot(&from_corner, &across) * scale;
        let along = cross(&from_corner, &self.edges[0]);
        let v = dot(&ray.direction, &along) * scale;
        let t = dot(&self.edges[1], &along) * scale;
        // A degenerate triangle gives infinite or NaN weights, for which `inside` is false.
        let low = Vec4::splat(-EDGE_SLACK);
        let inside = u.cmpge(low) & v.cmpge(low) & (u + v).cmple(Vec4::splat(1.0 + EDGE_SLACK));
        let within = t.cmpgt(ray.t_min) & t.cmplt(Vec4::splat(t_max));
        (u, v, t, (inside & within).bitmask())
    }
}

#[inline]
fn cross(a: &Lanes, b: &Lanes) -> Lanes {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline]
fn dot(a: &Lanes, b: &Lanes) -> Vec4 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl Bvh {
    /// Builds a hierarchy over triangles, given by their corners. An empty slice is allowed. Panics if
    /// there are more than [`TRIANGLES_MAX`].
    pub fn build(triangles: &[[Vec3; 3]]) -> Self {
        Self { tree: build::build(triangles) }
    }

    /// The nearest hit of each ray. Fast if the rays are close together.
    pub fn nearest<const N: usize>(&self, rays: &[Ray; N]) -> [Option<Hit>; N] {
        let wide = rays.each_ref().map(WideRay::new);
        let mut t_max = rays.each_ref().map(|ray| ray.t_max);
        let mut nearest = [None; N];
        self.walk(rays, |leaf| {
            for i in 0..N {
                let (u, v, t, mut met) = leaf.intersect(&wide[i], t_max[i]);
                while met != 0 {
                    let lane = met.trailing_zeros() as usize;
                    met &= met - 1;
                    if t[lane] < t_max[i] {
                        t_max[i] = t[lane];
                        let barycentric = [u[lane], v[lane]];
                        nearest[i] = Some(Hit { t: t[lane], triangle: leaf.triangles[lane], barycentric });
                    }
                }
            }
            t_max.iter().copied().fold(f32::NEG_INFINITY, f32::max)
        });
        nearest
    }

    /// Whether each ray hits any triangle. Fast if the rays are close together.
    pub fn blocked<const N: usize>(&self, rays: &[Ray; N]) -> [bool; N] {
        let wide = rays.each_ref().map(WideRay::new);
        let longest = rays.iter().map(|ray| ray.t_max).fold(f32::NEG_INFINITY, f32::max);
        let mut blocked = [false; N];
        self.walk(rays, |leaf| {
            for i in 0..N {
                blocked[i] = blocked[i] || leaf.intersect(&wide[i], rays[i].t_max).3 != 0;
            }
            if blocked.iter().all(|&b| b) { f32::NEG_INFINITY } else { longest }
        });
        blocked
    }

    /// Calls `visit` with the leaves whose boxes the rays may meet, nearer leaves first. `visit` returns
    /// the largest `t` that still matters; negative infinity ends the walk.
    #[inline]
    fn walk(&self, rays: &[Ray], mut visit: impl FnMut(&Leaf) -> f32) {
        let beam = Beam::new(rays);
        let mut t_max = rays.iter().map(|ray| ray.t_max).fold(f32::NEG_INFINITY, f32::max);
        let mut stack = [(0u32, 0.0f32); STACK];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (child, enter) = stack[depth];
            if enter > t_max {
                continue;
            }
            if child & LEAF != 0 {
                t_max = visit(&self.tree.leaves[(child ^ LEAF) as usize]);
                if t_max == f32::NEG_INFINITY {
                    return;
                }
                continue;
            }
            let node = &self.tree.nodes[child as usize];
            let (enter, mut met) = node.enter(&beam, t_max);
            let enter = enter.to_array();
            let first = depth;
            while met != 0 {
                let lane = met.trailing_zeros() as usize;
                met &= met - 1;
                // Insertion sort, so that the nearest box ends on top of the stack.
                let mut at = depth;
                while at > first && stack[at - 1].1 < enter[lane] {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (node.children[lane], enter[lane]);
                depth += 1;
            }
        }
    }
}
