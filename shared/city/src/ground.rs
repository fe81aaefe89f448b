//! The ground as triangles: streets, and blocks that are a kerb higher and have rounded corners.

use glam::{Vec2, Vec3};

use super::material::Material;
use super::mesh::Mesh;
use super::plan::{Block, CORNER_RADIUS_M, KERB_HEIGHT_M, Plan};
use super::shapes::unit_circle;
use super::terrain::Terrain;

/// Longest side of a ground cell in town and outside it, metres.
const CELL_M: [f32; 2] = [2.2, 5.0];
/// Number of straight pieces of a rounded corner.
const CORNER_PIECES: usize = 5;
/// Height of a kerb, metres: it reaches into the street's surface.
const KERB_DEPTH_M: f32 = KERB_HEIGHT_M + 0.05;

/// Adds the ground to the mesh.
pub(super) fn build(mesh: &mut Mesh, plan: &Plan, terrain: &Terrain, town_half_m: f32) {
    let street = mesh.add(Material::Street);
    let kerb = mesh.add(Material::Kerb);
    let blocks = (0..plan.blocks.len()).map(|i| mesh.add(Material::Ground(i as u32))).collect();
    let lines = [0, 1].map(|axis| grid_lines(plan, axis, town_half_m));
    let mut ground = Ground { mesh, plan, terrain, street, kerb, blocks };
    for v in lines[1].windows(2) {
        for u in lines[0].windows(2) {
            ground.cell(Vec2::new(u[0], v[0]), Vec2::new(u[1], v[1]));
        }
    }
}

/// Coordinates at which the ground is cut along one axis: at kerbs, at the ends of rounded corners,
/// and in between so that no cell is too long.
fn grid_lines(plan: &Plan, axis: usize, town_half_m: f32) -> Vec<f32> {
    let mut lines = vec![-plan.half_side_m];
    let mut cut_to = |to: f32, whole: bool| {
        let from = lines[lines.len() - 1];
        let longest = CELL_M[usize::from(from.abs().min(to.abs()) > town_half_m * 1.2)];
        let pieces = if whole { 1 } else { ((to - from) / longest) as usize + 1 };
        let step = (to - from) / pieces as f32;
        lines.extend((1..pieces).map(|i| from + step * i as f32));
        lines.push(to);
    };
    for street in &plan.streets[axis] {
        let (low, high) = (street.at - street.half_width_m, street.at + street.half_width_m);
        cut_to(low - CORNER_RADIUS_M, false);
        cut_to(low, true);
        cut_to(high, false);
        cut_to(high + CORNER_RADIUS_M, true);
    }
    cut_to(plan.half_side_m, false);
    lines
}

struct Ground<'a> {
    mesh: &'a mut Mesh,
    plan: &'a Plan,
    terrain: &'a Terrain,
    street: u32,
    kerb: u32,
    blocks: Vec<u32>,
}

impl Ground<'_> {
    fn at(&self, uv: Vec2, raised_m: f32) -> Vec3 {
        let p = self.plan.to_world(uv);
        p.extend(self.terrain.height(p) + raised_m)
    }

    fn cell(&mut self, min: Vec2, max: Vec2) {
        let Some(index) = self.plan.block_at((min + max) * 0.5) else {
            return self.flat(min, max, 0.0, self.street);
        };
        let block = self.plan.blocks[index];
        let raised_m = if block.kind.in_town() { KERB_HEIGHT_M } else { 0.0 };
        let edges = Edges::of(&block, min, max);
        match edges.corner() {
            Some(outward) => self.corner(min, max, outward, raised_m, index),
            None => {
                self.flat(min, max, raised_m, self.blocks[index]);
                if raised_m > 0.0 {
                    self.kerbs(min, max, &edges);
                }
            }
        }
    }

    fn flat(&mut self, min: Vec2, max: Vec2, raised_m: f32, material: u32) {
        let uv = [min, Vec2::new(max.x, min.y), max, Vec2::new(min.x, max.y)];
        let corners = uv.map(|uv| self.at(uv, raised_m));
        self.mesh.quad(corners, uv, material);
    }

    fn kerbs(&mut self, min: Vec2, max: Vec2, edges: &Edges) {
        let (se, nw) = (Vec2::new(max.x, min.y), Vec2::new(min.x, max.y));
        for (is_edge, a, b) in
            [(edges.west, nw, min), (edges.east, se, max), (edges.south, min, se), (edges.north, max, nw)]
        {
            if is_edge {
                self.kerb(a, b);
            }
        }
    }

    fn kerb(&mut self, a: Vec2, b: Vec2) {
        let (top_a, top_b) = (self.at(a, KERB_HEIGHT_M), self.at(b, KERB_HEIGHT_M));
        let down = Vec3::NEG_Z * KERB_DEPTH_M;
        self.mesh.quad([top_a + down, top_b + down, top_b, top_a], [a, b, b, a], self.kerb);
    }

    /// Adds a cell at a block's corner: a quarter disc belongs to the block, the rest to the street.
    fn corner(&mut self, min: Vec2, max: Vec2, outward: Vec2, raised_m: f32, block: usize) {
        let half = (max - min) * 0.5;
        let (tip, center) = ((min + max) * 0.5 + outward * half, (min + max) * 0.5 - outward * half);
        let arc: Vec<Vec2> = (0..=CORNER_PIECES)
            .map(|i| {
                let d = match i {
                    0 => Vec2::X,
                    CORNER_PIECES => Vec2::Y,
                    _ => unit_circle(0.25 * i as f32 / CORNER_PIECES as f32),
                };
                center + outward * d * (max - min)
            })
            .collect();
        for piece in arc.windows(2) {
            let (a, b) = (piece[0], piece[1]);
            let inner = [center, a, b].map(|uv| self.at(uv, raised_m));
            self.mesh.triangle(inner, [center, a, b], self.blocks[block]);
            let outer = [tip, a, b].map(|uv| self.at(uv, 0.0));
            self.mesh.triangle(outer, [tip, a, b], self.street);
            if raised_m > 0.0 {
                self.kerb(a, b);
            }
        }
    }
}

/// Which sides of a cell lie on its block's border.
struct Edges {
    west: bool,
    east: bool,
    south: bool,
    north: bool,
}

impl Edges {
    fn of(block: &Block, min: Vec2, max: Vec2) -> Self {
        let near = |a: f32, b: f32| (a - b).abs() < 0.01;
        Self {
            west: near(min.x, block.min.x),
            east: near(max.x, block.max.x),
            south: near(min.y, block.min.y),
            north: near(max.y, block.max.y),
        }
    }

    /// The direction towards the block's corner, if the cell is at a corner.
    fn corner(&self) -> Option<Vec2> {
        let side = |low: bool, high: bool| {
            if low == high {
                0.0
            } else if low {
                -1.0
            } else {
                1.0
            }
        };
        let outward = Vec2::new(side(self.west, self.east), side(self.south, self.north));
        (outward.x != 0.0 && outward.y != 0.0).then_some(outward)
    }
}
