//! A bounding volume hierarchy over triangles, four boxes a node and four triangles a leaf, so that
//! each step of a ray is a handful of four-wide vector operations.

use glam::{Vec3, Vec4};

/// Triangles in a leaf; also boxes in a node.
const WIDTH: usize = 4;
/// Bins of the surface-area heuristic: beyond 12 to 16 finer ones stop paying (Wald 2007).
const BINS: usize = 16;
/// From this depth on parts are halved by count, which bounds the depth for any input.
const MEDIAN_DEPTH: usize = 12;
/// Three boxes wait on each level: [`MEDIAN_DEPTH`] levels and the 13 that 2²⁶ triangles need beyond.
const STACK: usize = 80;
/// Bit of a child that tells a leaf from a node.
const LEAF: u32 = 1 << 31;
/// By how much, in barycentric units, a ray may miss a triangle: closes the cracks that rounding
/// opens between neighbours.
const EDGE_SLACK: f32 = 1e-6;
/// Lengthens the part of a ray inside a box by more than rounding can shorten it.
const BOX_SLACK: f32 = 1.0 + 4e-7;

/// A ray; `t` counts lengths of `direction`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    /// Start.
    pub(super) origin: Vec3,
    /// Any length but zero.
    pub(super) direction: Vec3,
    /// Where it begins.
    pub(super) t_min: f32,
    /// Where it ends.
    pub(super) t_max: f32,
}

/// Where a ray met a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hit {
    /// Lengths of the ray's direction.
    pub(super) t: f32,
    /// Index into the triangles the hierarchy was built from.
    pub(super) triangle: u32,
    /// Weights of the second and third corner.
    pub(super) barycentric: [f32; 2],
}

/// Three coordinates of four vectors.
type Lanes = [Vec4; 3];

/// Four boxes and what they hold: a node, or with [`LEAF`] a leaf. Unused ones are empty boxes.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Node {
    min: Lanes,
    max: Lanes,
    children: [u32; WIDTH],
}

/// Four triangles as the intersection test wants them. Unused ones are degenerate.
#[derive(Clone, Copy, Debug)]
struct Leaf {
    corner: Lanes,
    edges: [Lanes; 2],
    triangles: [u32; WIDTH],
}

/// The hierarchy.
#[derive(Debug)]
pub(super) struct Bvh {
    nodes: Vec<Node>,
    leaves: Vec<Leaf>,
}

/// A ray with each coordinate in all four lanes.
struct WideRay {
    origin: Lanes,
    direction: Lanes,
    inverse: Lanes,
    t_min: Vec4,
}

impl WideRay {
    fn new(ray: &Ray) -> Self {
        let splat = |v: Vec3| v.to_array().map(Vec4::splat);
        // Zeros are replaced so that no box test sees 0 * infinity.
        let safe = |x: f32| if x.abs() < 1e-20 { 1e20 } else { 1.0 / x };
        let d = ray.direction;
        Self {
            origin: splat(ray.origin),
            direction: splat(d),
            inverse: splat(Vec3::new(safe(d.x), safe(d.y), safe(d.z))),
            t_min: Vec4::splat(ray.t_min),
        }
    }
}

impl Node {
    const EMPTY: Self = Self { min: [Vec4::MAX; 3], max: [Vec4::MIN; 3], children: [LEAF; WIDTH] };

    /// Where the ray enters each box, and which boxes it meets before `t_max`, one bit each.
    #[inline]
    fn enter(&self, ray: &WideRay, t_max: f32) -> (Vec4, u32) {
        let mut enter = ray.t_min;
        let mut leave = Vec4::splat(t_max);
        for axis in 0..3 {
            let low = (self.min[axis] - ray.origin[axis]) * ray.inverse[axis];
            let high = (self.max[axis] - ray.origin[axis]) * ray.inverse[axis];
            enter = enter.max(low.min(high));
            leave = leave.min(low.max(high) * BOX_SLACK);
        }
        // Turned inside out, an empty box looks endless from within: its order tells it.
        let real = self.min[0].cmple(self.max[0]);
        (enter, (enter.cmple(leave) & real).bitmask())
    }
}

impl Leaf {
    const EMPTY: Self = Self { corner: [Vec4::ZERO; 3], edges: [[Vec4::ZERO; 3]; 2], triangles: [0; WIDTH] };

    /// Möller–Trumbore, both sides: weights, `t`, and which triangles are met before `t_max`.
    #[inline]
    fn intersect(&self, ray: &WideRay, t_max: f32) -> (Vec4, Vec4, Vec4, u32) {
        let across = cross(&ray.direction, &self.edges[1]);
        let scale = Vec4::ONE / dot(&self.edges[0], &across);
        let from_corner = [0, 1, 2].map(|axis| ray.origin[axis] - self.corner[axis]);
        let u = dot(&from_corner, &across) * scale;
        let along = cross(&from_corner, &self.edges[0]);
        let v = dot(&ray.direction, &along) * scale;
        let t = dot(&self.edges[1], &along) * scale;
        // Phrased so that the NaN of a degenerate triangle fails.
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
    /// Builds over at most 2²⁶ triangles given by their corners; there may be none.
    pub(super) fn build(triangles: &[[Vec3; 3]]) -> Self {
        assert!(triangles.len() <= 1 << 26, "{} triangles are more than the stack is for", triangles.len());
        let boxes: Vec<Aabb> = triangles.iter().map(Aabb::of).collect();
        let mut order: Vec<u32> = (0..triangles.len() as u32).collect();
        let mut builder = Builder { triangles, boxes: &boxes, nodes: vec![Node::EMPTY], leaves: Vec::new() };
        builder.split(0, &mut order, 0);
        Self { nodes: builder.nodes, leaves: builder.leaves }
    }

    /// The nearest triangle.
    pub(super) fn nearest(&self, ray: &Ray) -> Option<Hit> {
        let mut nearest = None;
        let mut t_max = ray.t_max;
        self.walk(ray, |leaf, wide| {
            let (u, v, t, mut met) = leaf.intersect(wide, t_max);
            while met != 0 {
                let lane = met.trailing_zeros() as usize;
                met &= met - 1;
                if t[lane] < t_max {
                    t_max = t[lane];
                    let barycentric = [u[lane], v[lane]];
                    nearest = Some(Hit { t: t_max, triangle: leaf.triangles[lane], barycentric });
                }
            }
            t_max
        });
        nearest
    }

    /// Whether anything is in the way.
    pub(super) fn blocked(&self, ray: &Ray) -> bool {
        let mut blocked = false;
        self.walk(ray, |leaf, wide| {
            blocked = leaf.intersect(wide, ray.t_max).3 != 0;
            if blocked { f32::NEG_INFINITY } else { ray.t_max }
        });
        blocked
    }

    /// Shows `visit` the leaves whose boxes the ray meets, nearer ones first. `visit` says how far
    /// the ray still goes; negative infinity ends the walk.
    #[inline]
    fn walk(&self, ray: &Ray, mut visit: impl FnMut(&Leaf, &WideRay) -> f32) {
        let wide = WideRay::new(ray);
        let mut t_max = ray.t_max;
        let mut stack = [(0u32, 0.0f32); STACK];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (child, enter) = stack[depth];
            if enter > t_max {
                continue;
            }
            if child & LEAF != 0 {
                t_max = visit(&self.leaves[(child ^ LEAF) as usize], &wide);
                if t_max == f32::NEG_INFINITY {
                    return;
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let (enter, mut met) = node.enter(&wide, t_max);
            let enter = enter.to_array();
            let first = depth;
            while met != 0 {
                let lane = met.trailing_zeros() as usize;
                met &= met - 1;
                // Sorted in as it comes: the nearest ends on top.
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

#[derive(Clone, Copy, Debug)]
struct Aabb {
    min: Vec3,
    max: Vec3,
}

impl Aabb {
    const EMPTY: Self = Self { min: Vec3::MAX, max: Vec3::MIN };

    fn grow(&mut self, other: &Self) {
        self.min = self.min.min(other.min);
        self.max = self.max.max(other.max);
    }

    fn of(corners: &[Vec3; 3]) -> Self {
        Self {
            min: corners[0].min(corners[1]).min(corners[2]),
            max: corners[0].max(corners[1]).max(corners[2]),
        }
    }

    fn half_area(&self) -> f32 {
        let d = self.max - self.min;
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

struct Builder<'a> {
    triangles: &'a [[Vec3; 3]],
    boxes: &'a [Aabb],
    nodes: Vec<Node>,
    leaves: Vec<Leaf>,
}

/// A plane between two bins.
struct Cut {
    cost: f32,
    axis: usize,
    /// First bin of the right part.
    bin: usize,
}

impl Builder<'_> {
    /// Gives `node` up to four children that hold the triangles of `order`.
    fn split(&mut self, node: usize, order: &mut [u32], depth: usize) {
        let mut parts: Vec<&mut [u32]> = vec![order];
        while parts.len() < WIDTH {
            // The part most rays will enter is opened next.
            let widest = (0..parts.len()).filter(|&i| parts[i].len() > WIDTH).max_by(|&i, &j| {
                self.bounds(parts[i]).half_area().total_cmp(&self.bounds(parts[j]).half_area())
            });
            let Some(widest) = widest else { break };
            let part = parts.swap_remove(widest);
            let middle = if depth < MEDIAN_DEPTH { self.partition(part) } else { part.len() / 2 };
            let (left, right) = part.split_at_mut(middle);
            parts.extend([left, right]);
        }
        for (lane, part) in parts.into_iter().enumerate().filter(|(_, part)| !part.is_empty()) {
            let bounds = self.bounds(part);
            for axis in 0..3 {
                self.nodes[node].min[axis][lane] = bounds.min[axis];
                self.nodes[node].max[axis][lane] = bounds.max[axis];
            }
            self.nodes[node].children[lane] = if part.len() <= WIDTH {
                self.leaf(part)
            } else {
                let child = self.nodes.len();
                self.nodes.push(Node::EMPTY);
                self.split(child, part, depth + 1);
                child as u32
            };
        }
    }

    fn leaf(&mut self, part: &[u32]) -> u32 {
        let mut leaf = Leaf::EMPTY;
        for (lane, &triangle) in part.iter().enumerate() {
            let [a, b, c] = self.triangles[triangle as usize];
            for axis in 0..3 {
                leaf.corner[axis][lane] = a[axis];
                leaf.edges[0][axis][lane] = (b - a)[axis];
                leaf.edges[1][axis][lane] = (c - a)[axis];
            }
            leaf.triangles[lane] = triangle;
        }
        self.leaves.push(leaf);
        (self.leaves.len() - 1) as u32 | LEAF
    }

    fn bounds(&self, part: &[u32]) -> Aabb {
        let mut bounds = Aabb::EMPTY;
        part.iter().for_each(|&i| bounds.grow(&self.boxes[i as usize]));
        bounds
    }

    fn center(&self, triangle: u32) -> Vec3 {
        let b = &self.boxes[triangle as usize];
        (b.min + b.max) * 0.5
    }

    /// Reorders `order` into two parts of least expected cost; returns where the second begins.
    fn partition(&self, order: &mut [u32]) -> usize {
        let (mut low, mut high) = (Vec3::MAX, Vec3::MIN);
        for &i in order.iter() {
            low = low.min(self.center(i));
            high = high.max(self.center(i));
        }
        let best = (0..3)
            .filter(|&axis| high[axis] > low[axis])
            .map(|axis| self.best_cut(order, axis, low[axis], high[axis]))
            .min_by(|a, b| a.cost.total_cmp(&b.cost));
        let Some(cut) = best else { return order.len() / 2 };
        let mut middle = 0;
        for i in 0..order.len() {
            if bin(self.center(order[i])[cut.axis], low[cut.axis], high[cut.axis]) < cut.bin {
                order.swap(i, middle);
                middle += 1;
            }
        }
        if middle == 0 || middle == order.len() { order.len() / 2 } else { middle }
    }

    fn best_cut(&self, order: &[u32], axis: usize, low: f32, high: f32) -> Cut {
        let mut bins = [(Aabb::EMPTY, 0usize); BINS];
        for &i in order {
            let slot = &mut bins[bin(self.center(i)[axis], low, high)];
            slot.0.grow(&self.boxes[i as usize]);
            slot.1 += 1;
        }
        // A leaf costs the same however full, so what counts is how many there will be.
        let cost = |bounds: &Aabb, count: usize| match count {
            0 => 0.0,
            _ => bounds.half_area() * count.div_ceil(WIDTH) as f32,
        };
        let mut right_cost = [0.0f32; BINS];
        let (mut bounds, mut count) = (Aabb::EMPTY, 0);
        for b in (1..BINS).rev() {
            bounds.grow(&bins[b].0);
            count += bins[b].1;
            right_cost[b] = cost(&bounds, count);
        }
        let (mut bounds, mut count) = (Aabb::EMPTY, 0);
        let mut best = Cut { cost: f32::INFINITY, axis, bin: 1 };
        for b in 1..BINS {
            bounds.grow(&bins[b - 1].0);
            count += bins[b - 1].1;
            let cost = cost(&bounds, count) + right_cost[b];
            if cost < best.cost {
                best = Cut { cost, axis, bin: b };
            }
        }
        best
    }
}

fn bin(x: f32, low: f32, high: f32) -> usize {
    (((x - low) / (high - low) * BINS as f32) as usize).min(BINS - 1)
}
