//! The city's plan: a grid of streets and rectangular blocks in plan coordinates (u, v). A smooth bend
//! maps plan coordinates to the world, so that streets curve and blocks differ.

use glam::{Vec2, Vec3};

use super::detail::Detail;
use super::noise::noise2;
use super::random::{Rng, hash2};
use super::shapes::Frame;
use super::terrain::Terrain;

/// Height of a town block's ground above the street, metres.
pub(super) const KERB_HEIGHT_M: f32 = 0.14;
/// Radius of the kerb at a block's corners, metres.
pub(super) const CORNER_RADIUS_M: f32 = 3.2;
/// Width of the city's built-up part beyond the flown square, metres.
const TOWN_MARGIN_M: f32 = 30.0;
/// Wavelength and amplitude of the bend between plan and world, metres.
const BEND_M: (f32, f32) = (150.0, 11.0);

/// What stands on a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BlockKind {
    /// Terraced houses around a courtyard.
    Perimeter,
    /// A church on a paved square.
    Plaza,
    /// Detached houses in gardens.
    Villas,
    /// Lawns, paths, a pond.
    Park,
    /// Stepped towers on a paved block.
    Towers,
    /// Long apartment houses.
    Slabs,
    /// Halls and a car park.
    Hall,
    /// A school with a pitch.
    School,
    /// Crops in rows.
    Field,
    /// Grass with single trees and bales.
    Meadow,
    /// Trees.
    Forest,
    /// Trees in rows.
    Orchard,
    /// A farm.
    Farm,
}

impl BlockKind {
    /// Whether the block has kerbs and pavements.
    pub(super) fn in_town(self) -> bool {
        !matches!(self, Self::Field | Self::Meadow | Self::Forest | Self::Orchard | Self::Farm)
    }
}

/// A street along one axis of the plan.
#[derive(Clone, Copy, Debug)]
pub(super) struct Street {
    /// Position of its centre line, plan metres.
    pub(super) at: f32,
    /// Distance from the centre line to the kerb.
    pub(super) half_width_m: f32,
    /// Whether it has lanes with markings.
    pub(super) main: bool,
}

/// The land between streets.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    /// Corner of least u and v, at the kerb.
    pub(super) min: Vec2,
    /// Corner of greatest u and v, at the kerb.
    pub(super) max: Vec2,
    pub(super) kind: BlockKind,
    pub(super) seed: u32,
}

/// Streets and blocks.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    seed: u32,
    /// Cosine and sine of the plan's rotation relative to the world.
    turn: Vec2,
    /// Whether objects in town have fine detail.
    fine: bool,
    /// Half the side of the square that the plan covers, plan metres.
    pub(super) half_side_m: f32,
    /// Half the side of the world square that is town.
    town_half_m: f32,
    /// Streets of constant u and of constant v, each sorted.
    pub(super) streets: [Vec<Street>; 2],
    pub(super) blocks: Vec<Block>,
    /// Block of each cell between streets, `[v][u]`.
    cells: Vec<u32>,
}

impl Plan {
    /// Plans a city around a flown square, with open country up to `reach_m` from the centre.
    pub(super) fn new(seed: u64, flown_half_m: f32, reach_m: f32, fine: bool) -> Self {
        let mut rng = Rng::new(seed, 1);
        let t = rng.range(0.06, 0.22);
        let turn = Vec2::new(1.0 - t * t, 2.0 * t) * (1.0 / (1.0 + t * t));
        // The rotated plan must cover the world's square even where the bend moves its border inwards.
        let half_side_m = reach_m * (turn.x + turn.y) + BEND_M.1;
        let town_half_m = flown_half_m + TOWN_MARGIN_M;
        let streets = [(); 2].map(|()| lay_streets(&mut rng, half_side_m, town_half_m));
        let mut plan = Self {
            seed: rng.seed(),
            turn,
            fine,
            half_side_m,
            town_half_m,
            cells: vec![u32::MAX; (streets[0].len() + 1) * (streets[1].len() + 1)],
            streets,
            blocks: Vec::new(),
        };
        plan.join_cells(&mut rng);
        plan.assign_kinds(&mut rng);
        plan
    }

    /// The world position of a plan position.
    pub(super) fn to_world(&self, uv: Vec2) -> Vec2 {
        let p = uv * (1.0 / BEND_M.0);
        let bend = Vec2::new(noise2(p, self.seed), noise2(p, self.seed ^ 0x2545_f491)) * BEND_M.1;
        let q = uv + bend;
        Vec2::new(self.turn.x * q.x - self.turn.y * q.y, self.turn.y * q.x + self.turn.x * q.y)
    }

    /// A horizontal frame on the ground at `uv` whose x axis follows the plan direction `along`.
    pub(super) fn frame(&self, terrain: &Terrain, uv: Vec2, along: Vec2) -> Frame {
        let origin = self.to_world(uv);
        let x = (self.to_world(uv + along) - self.to_world(uv - along)).normalize();
        let kerb = match self.block_at(uv) {
            Some(block) if self.blocks[block].kind.in_town() => KERB_HEIGHT_M,
            _ => 0.0,
        };
        Frame {
            origin: origin.extend(terrain.height(origin) + kerb),
            x: x.extend(0.0),
            y: Vec3::new(-x.y, x.x, 0.0),
        }
    }

    /// Whether a plan position is in town.
    pub(super) fn in_town(&self, uv: Vec2) -> bool {
        self.to_world(uv).abs().max_element() < self.town_half_m
    }

    /// The detail of objects at a plan position.
    pub(super) fn detail(&self, uv: Vec2) -> Detail {
        if self.fine && self.in_town(uv) { Detail::Fine } else { Detail::Coarse }
    }

    /// Index of the block at `uv`; `None` on a street.
    pub(super) fn block_at(&self, uv: Vec2) -> Option<usize> {
        let (u, v) = (self.columns(0, uv.x), self.columns(1, uv.y));
        let first = self.cell(u[0], v[0]);
        let same = u.iter().all(|&u| v.iter().all(|&v| self.cell(u, v) == first));
        same.then_some(first as usize)
    }

    /// Index of the street of constant u (`axis` 0) or v (1) that covers the coordinate `x`.
    pub(super) fn street_at(&self, axis: usize, x: f32) -> Option<usize> {
        let streets = &self.streets[axis];
        let next = streets.partition_point(|s| s.at + s.half_width_m < x);
        (next < streets.len() && x >= streets[next].at - streets[next].half_width_m).then_some(next)
    }

    /// A hash of a cell of the street grid.
    pub(super) fn hash(&self, i: usize, j: usize) -> u32 {
        hash2(i as i32, j as i32, self.seed)
    }

    /// The columns on both sides of the street at `x`, or twice the column that contains `x`.
    fn columns(&self, axis: usize, x: f32) -> [usize; 2] {
        match self.street_at(axis, x) {
            Some(street) => [street, street + 1],
            None => [self.streets[axis].partition_point(|s| s.at < x); 2],
        }
    }

    fn cell(&self, u: usize, v: usize) -> u32 {
        self.cells[v * (self.streets[0].len() + 1) + u]
    }

    /// The begin and end of column `i`, from kerb to kerb.
    fn span(&self, axis: usize, i: usize) -> (f32, f32) {
        let streets = &self.streets[axis];
        let low = if i == 0 { -self.half_side_m } else { streets[i - 1].at + streets[i - 1].half_width_m };
        let high = streets.get(i).map_or(self.half_side_m, |street| street.at - street.half_width_m);
        (low, high)
    }

    /// Joins neighbouring cells into blocks: seldom in town, mostly in the country.
    fn join_cells(&mut self, rng: &mut Rng) {
        let [nu, nv] = [self.streets[0].len() + 1, self.streets[1].len() + 1];
        for v in 0..nv {
            for u in 0..nu {
                if self.cell(u, v) != u32::MAX {
                    continue;
                }
                let town = self.cell_in_town(u, v);
                let wanted = match (town, rng.unit()) {
                    (true, x) if x < 0.80 => (1, 1),
                    (true, x) if x < 0.90 => (2, 1),
                    (true, _) => (1, 2),
                    (false, x) if x < 0.2 => (1, 1),
                    (false, x) if x < 0.5 => (2, 1),
                    (false, x) if x < 0.7 => (1, 2),
                    (false, _) => (2, 2),
                };
                let free = |w: usize, h: usize| self.may_join(u, v, w, h, town);
                let (w, h) = match wanted {
                    (w, h) if free(w, h) => (w, h),
                    (2, 2) if free(2, 1) => (2, 1),
                    (_, 2) if free(1, 2) => (1, 2),
                    _ => (1, 1),
                };
                let id = self.blocks.len() as u32;
                for (x, y) in (u..u + w).flat_map(|x| (v..v + h).map(move |y| (x, y))) {
                    self.cells[y * nu + x] = id;
                }
                let (low_u, low_v) = (self.span(0, u).0, self.span(1, v).0);
                self.blocks.push(Block {
                    min: Vec2::new(low_u, low_v),
                    max: Vec2::new(self.span(0, u + w - 1).1, self.span(1, v + h - 1).1),
                    kind: if town { BlockKind::Villas } else { BlockKind::Meadow },
                    seed: rng.seed(),
                });
            }
        }
    }

    fn may_join(&self, u: usize, v: usize, w: usize, h: usize, town: bool) -> bool {
        let [nu, nv] = [self.streets[0].len() + 1, self.streets[1].len() + 1];
        u + w <= nu
            && v + h <= nv
            && (u + 1..u + w).all(|i| !self.streets[0][i - 1].main)
            && (v + 1..v + h).all(|i| !self.streets[1][i - 1].main)
            && (u..u + w)
                .all(|x| (v..v + h).all(|y| self.cell(x, y) == u32::MAX && self.cell_in_town(x, y) == town))
    }

    fn cell_in_town(&self, u: usize, v: usize) -> bool {
        let ((u0, u1), (v0, v1)) = (self.span(0, u), self.span(1, v));
        self.in_town(Vec2::new(u0 + u1, v0 + v1) * 0.5)
    }

    /// Assigns kinds to town blocks from the centre outwards, and to country blocks at random.
    fn assign_kinds(&mut self, rng: &mut Rng) {
        use BlockKind::*;
        // The inner blocks have every kind at least once; farther out, houses prevail.
        const INNER: [BlockKind; 11] =
            [Perimeter, Plaza, Towers, Perimeter, Park, Villas, Slabs, Perimeter, School, Villas, Hall];
        const OUTER: [BlockKind; 8] = [Villas, Villas, Perimeter, Slabs, Villas, Hall, Park, Villas];
        const COUNTRY: [BlockKind; 10] =
            [Field, Forest, Field, Meadow, Orchard, Field, Farm, Forest, Field, Meadow];
        let mut by_distance: Vec<(f32, usize)> = self
            .blocks
            .iter()
            .enumerate()
            .map(|(i, b)| (self.to_world((b.min + b.max) * 0.5).length() + rng.range(0.0, 30.0), i))
            .collect();
        by_distance.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut wanted = INNER.to_vec();
        let mut country = rng.index(COUNTRY.len());
        for (_, i) in by_distance {
            let block = &mut self.blocks[i];
            if block.kind == Villas {
                let size = block.max - block.min;
                // A square on a double block would look empty.
                let fits = |kind: &BlockKind| *kind != Plaza || size.max_element() < 1.5 * size.min_element();
                let next = wanted.iter().position(fits).map(|at| wanted.remove(at));
                block.kind = next.unwrap_or_else(|| rng.pick(&OUTER));
            } else {
                block.kind = COUNTRY[country % COUNTRY.len()];
                country += 1 + rng.index(2);
            }
        }
    }
}

fn lay_streets(rng: &mut Rng, half_side_m: f32, town_half_m: f32) -> Vec<Street> {
    let mut streets = Vec::new();
    let mut at = -half_side_m + rng.range(20.0, 60.0);
    while at < half_side_m - 20.0 {
        let town = at.abs() < town_half_m * 1.15;
        streets.push(Street { at, half_width_m: if town { 4.1 } else { 2.4 }, main: false });
        at += if town { rng.range(46.0, 70.0) } else { rng.range(50.0, 80.0) };
    }
    let nearest = streets.iter_mut().min_by(|a, b| a.at.abs().total_cmp(&b.at.abs()));
    if let Some(street) = nearest {
        *street = Street { half_width_m: 6.0, main: true, ..*street };
    }
    streets
}
