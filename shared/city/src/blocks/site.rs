//! A block under construction: which positions are free, and helpers for all kinds of blocks.

use glam::{Vec2, Vec3};

use crate::building::Lot;
use crate::facade::Wall;
use crate::mesh::Mesh;
use crate::palette::Palette;
use crate::paving::{Outline, PAVEMENT_M, Patch, Surface};
use crate::plan::{Block, Plan};
use crate::random::Rng;
use crate::roofing::Cover;
use crate::shapes::Frame;
use crate::terrain::Terrain;
use crate::tree::{self, Habit};

/// A block under construction.
pub(super) struct Site<'a> {
    pub(super) mesh: &'a mut Mesh,
    pub(super) plan: &'a Plan,
    pub(super) terrain: &'a Terrain,
    pub(super) palette: &'a Palette,
    pub(super) block: Block,
    pub(super) rng: Rng,
    pub(super) patches: Vec<Patch>,
    /// Plan rectangles that are occupied or reserved.
    taken: Vec<(Vec2, Vec2)>,
}

/// A side of a block. The block lies to the left of the direction `along`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Side {
    pub(super) start: Vec2,
    pub(super) along: Vec2,
    /// Unit, into the block.
    pub(super) inward: Vec2,
    pub(super) length_m: f32,
}

impl Side {
    /// The plan position `along_m` from the side's start and `depth_m` into the block.
    pub(super) fn at(&self, along_m: f32, depth_m: f32) -> Vec2 {
        self.start + self.along * along_m + self.inward * depth_m
    }

    /// The plan rectangle between two positions, each `(along_m, depth_m)`.
    pub(super) fn rectangle(&self, a: (f32, f32), b: (f32, f32)) -> (Vec2, Vec2) {
        let (p, q) = (self.at(a.0, a.1), self.at(b.0, b.1));
        (p.min(q), p.max(q))
    }
}

impl<'a> Site<'a> {
    pub(super) fn new(
        mesh: &'a mut Mesh,
        plan: &'a Plan,
        terrain: &'a Terrain,
        palette: &'a Palette,
        block: Block,
    ) -> Self {
        let rng = Rng::new(u64::from(block.seed), 2);
        Self { mesh, plan, terrain, palette, block, rng, patches: Vec::new(), taken: Vec::new() }
    }

    pub(super) fn size(&self) -> Vec2 {
        self.block.max - self.block.min
    }

    pub(super) fn center(&self) -> Vec2 {
        (self.block.min + self.block.max) * 0.5
    }

    /// The south, east, north and west side.
    pub(super) fn sides(&self) -> [Side; 4] {
        let (min, max) = (self.block.min, self.block.max);
        let size = self.size();
        let side = |start, along: Vec2, length_m| Side { start, along, inward: along.perp(), length_m };
        [
            side(min, Vec2::X, size.x),
            side(Vec2::new(max.x, min.y), Vec2::Y, size.y),
            side(max, Vec2::NEG_X, size.x),
            side(Vec2::new(min.x, max.y), Vec2::NEG_Y, size.y),
        ]
    }

    /// A frame on the ground; see [`Plan::frame`].
    pub(super) fn frame(&self, uv: Vec2, along: Vec2) -> Frame {
        self.plan.frame(self.terrain, uv, along)
    }

    /// The world position of the ground at a plan position.
    pub(super) fn ground(&self, uv: Vec2) -> Vec3 {
        self.frame(uv, Vec2::X).origin
    }

    /// Reserves a lot for a building of `size_m` centred at `uv`. Its floor lies above the highest ground
    /// under it.
    pub(super) fn lot(&mut self, uv: Vec2, along: Vec2, size_m: Vec2) -> Lot {
        let mut frame = self.frame(uv, along);
        let half = size_m * 0.5;
        let heights = [-1.0, 0.0, 1.0].map(|y| {
            [-1.0, 0.0, 1.0].map(|x| {
                let corner = frame.at(x * half.x, y * half.y, 0.0);
                self.terrain.height(corner.truncate())
            })
        });
        let all = heights.as_flattened();
        let high = all.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let low = all.iter().copied().fold(f32::INFINITY, f32::min);
        frame.origin.z = high + crate::plan::KERB_HEIGHT_M + 0.12;
        let reach = half.x * along.abs() + half.y * along.perp().abs();
        self.taken.push((uv - reach, uv + reach));
        Lot { frame, depth_m: high - low + 0.6 }
    }

    /// Keeps later objects off a plan rectangle.
    pub(super) fn reserve(&mut self, (min, max): (Vec2, Vec2)) {
        self.taken.push((min, max));
    }

    /// Covers ground with a patch; later patches lie on top.
    pub(super) fn cover(&mut self, outline: Outline, surface: Surface) {
        self.patches.push(Patch { outline, surface });
    }

    /// Covers a plan rectangle.
    pub(super) fn cover_rectangle(&mut self, (min, max): (Vec2, Vec2), surface: Surface) {
        self.cover(Outline::Rectangle(min, max), surface);
    }

    /// Whether a plan position lies inside the block and nothing occupies the ground within `margin_m`.
    pub(super) fn is_free(&self, uv: Vec2, margin_m: f32) -> bool {
        let edge = if self.block.kind.in_town() { PAVEMENT_M } else { 0.0 };
        let inside = (uv - self.block.min).min(self.block.max - uv).min_element() > edge + 0.5 * margin_m;
        let clear = |&(min, max): &(Vec2, Vec2)| {
            let out = (min - uv).max(uv - max);
            out.max_element() > margin_m
        };
        inside && self.taken.iter().all(clear)
    }

    /// A random free position; `None` after eight failed tries.
    pub(super) fn free_spot(&mut self, margin_m: f32) -> Option<Vec2> {
        (0..8).find_map(|_| {
            let t = Vec2::new(self.rng.unit(), self.rng.unit());
            let uv = self.block.min + self.size() * t;
            self.is_free(uv, margin_m).then_some(uv)
        })
    }

    /// Plants a tree and reserves the ground around its trunk.
    pub(super) fn plant(&mut self, uv: Vec2, habit: Habit, height_m: f32) {
        let frame = self.frame(uv, Vec2::X);
        let detail = self.plan.detail(uv);
        tree::tree(self.mesh, &frame, habit, height_m, detail, self.palette, &mut self.rng);
        let room = 0.16 * height_m;
        self.taken.push((uv - room, uv + room));
    }

    /// Plants up to `count` trees at random free positions.
    pub(super) fn scatter(&mut self, count: usize, habits: &[Habit], heights_m: (f32, f32)) {
        for _ in 0..count {
            let height_m = self.rng.range(heights_m.0, heights_m.1);
            if let Some(uv) = self.free_spot(0.16 * height_m) {
                let habit = self.rng.pick(habits);
                self.plant(uv, habit, height_m);
            }
        }
    }

    /// A random wall of the old town.
    pub(super) fn town_wall(&mut self) -> Wall {
        use Wall::*;
        self.rng.pick(&[Plaster, Plaster, Plaster, Brick, Brick, Timbered, Stone])
    }

    /// A random cover for a steep roof.
    pub(super) fn steep_cover(&mut self) -> Cover {
        use Cover::*;
        self.rng.pick(&[Tiles, Tiles, Tiles, Tiles, Slate, Sheet])
    }

    /// A random cover for a flat roof.
    pub(super) fn flat_cover(&mut self) -> Cover {
        use Cover::*;
        self.rng.pick(&[Gravel, Felt, Felt, Sedum, Gravel])
    }
}
