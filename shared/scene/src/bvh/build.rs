//! Builds the hierarchy. Each node is split by the binned surface-area heuristic until it has four
//! children.

use glam::Vec3;

use super::node::{LEAF, Leaf, Node, Tree, WIDTH};

/// Number of bins of the surface-area heuristic along an axis; more than 12 to 16 bring no gain (Wald
/// 2007).
const BINS: usize = 16;

/// From this depth on, nodes are split into halves of equal triangle count, which bounds the depth of the
/// tree.
pub(super) const MEDIAN_DEPTH: usize = 12;

/// Largest number of triangles in a hierarchy.
pub(super) const TRIANGLES_MAX: usize = 1 << 26;

/// Builds a hierarchy over triangles, given by their corners. Panics if there are more than
/// [`TRIANGLES_MAX`].
pub(super) fn build(triangles: &[[Vec3; 3]]) -> Tree {
    assert!(
        triangles.len() <= TRIANGLES_MAX,
        "{} triangles exceed the limit of {TRIANGLES_MAX}",
        triangles.len()
    );
    let boxes: Vec<Aabb> = triangles.iter().map(Aabb::of).collect();
    let mut order: Vec<u32> = (0..triangles.len() as u32).collect();
    let mut builder = Builder { triangles, boxes: &boxes, nodes: vec![Node::EMPTY], leaves: Vec::new() };
    builder.split(0, &mut order, 0);
    Tree { nodes: builder.nodes, leaves: builder.leaves }
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

/// A plane that splits a node, between two bins along an axis.
struct Cut {
    cost: f32,
    axis: usize,
    /// Index of the first bin beyond the plane.
    bin: usize,
}

impl Builder<'_> {
    /// Gives `node` up to four children that hold the triangles of `order`.
    fn split(&mut self, node: usize, order: &mut [u32], depth: usize) {
        let mut parts: Vec<&mut [u32]> = vec![order];
        while parts.len() < WIDTH {
            // The part with the largest surface is split next, because most rays enter it.
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
                self.nodes[node].bounds[0][axis][lane] = bounds.min[axis];
                self.nodes[node].bounds[1][axis][lane] = bounds.max[axis];
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

    /// Reorders `order` into two parts for which tracing is expected to cost least. Returns the index at
    /// which the second part begins.
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
        // A full leaf costs no more than one with a single triangle, so the cost counts leaves instead of
        // triangles.
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
