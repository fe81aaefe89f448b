//! Objects along the streets: parked and moving cars, lamps, poles, street trees.

use glam::Vec2;

use super::mesh::Mesh;
use super::palette::Palette;
use super::plan::{Plan, Street};
use super::props::{self, Vehicle};
use super::random::Rng;
use super::terrain::Terrain;
use super::tree::{self, Habit};

/// Distance between possible positions of objects, metres: the length of a parking bay.
const STEP_M: f32 = 5.6;
/// Least distance of parked cars from a crossing street's kerb, metres.
const CROSSING_M: f32 = 9.0;

/// Adds the objects along all streets.
pub(super) fn furnish(mesh: &mut Mesh, plan: &Plan, terrain: &Terrain, palette: &Palette, rng: &mut Rng) {
    for axis in 0..2 {
        for (index, street) in plan.streets[axis].iter().enumerate() {
            let mut walk = Walk { mesh, plan, terrain, palette, rng, axis, index, street: *street };
            let steps = (2.0 * plan.half_side_m / STEP_M) as usize;
            for step in 0..steps {
                walk.place(step, -plan.half_side_m + STEP_M * (step as f32 + 0.5));
            }
        }
    }
}

struct Walk<'a> {
    mesh: &'a mut Mesh,
    plan: &'a Plan,
    terrain: &'a Terrain,
    palette: &'a Palette,
    rng: &'a mut Rng,
    axis: usize,
    index: usize,
    street: Street,
}

impl Walk<'_> {
    fn uv(&self, along: f32, across: f32) -> Vec2 {
        let x = self.street.at + across;
        if self.axis == 0 { Vec2::new(x, along) } else { Vec2::new(along, x) }
    }

    /// The plan's direction along the street.
    fn along(&self) -> Vec2 {
        if self.axis == 0 { Vec2::Y } else { Vec2::X }
    }

    fn place(&mut self, step: usize, at: f32) {
        if self.plan.block_at(self.uv(at, 0.0)).is_some() {
            return;
        }
        let clear =
            self.plan.streets[1 - self.axis].iter().all(|s| (s.at - at).abs() > s.half_width_m + CROSSING_M);
        let town = self.plan.in_town(self.uv(at, 0.0));
        let half = self.street.half_width_m;
        // `across` grows to the right of streets along one axis, and to the left along the other.
        let handed = if self.axis == 0 { 1.0 } else { -1.0 };
        for side in [-1.0, 1.0] {
            if town && clear {
                self.park(at, side * (half - 1.05), 0.52);
            }
            if town && step % 4 == usize::from(side > 0.0) * 2 {
                let uv = self.uv(at + 2.2, side * (half + 0.45));
                let frame = self.plan.frame(self.terrain, uv, self.along() * side * handed);
                props::lamp(self.mesh, &frame, self.palette);
            }
            if town && clear && step % 2 == 1 && (self.street.main || self.index.is_multiple_of(3)) {
                self.street_tree(at, side * (half + 1.0));
            }
        }
        if clear && self.rng.chance(if town { 0.10 } else { 0.05 }) {
            let side = if self.rng.chance(0.5) { 1.0 } else { -1.0 };
            self.drive(at, side * handed * 0.32 * (half - 1.0), side);
        }
        if !town && step.is_multiple_of(6) && self.index.is_multiple_of(2) {
            let uv = self.uv(at, half + 1.3);
            let frame = self.plan.frame(self.terrain, uv, self.along());
            props::pole(self.mesh, &frame, self.palette);
        }
    }

    fn park(&mut self, at: f32, across: f32, chance: f32) {
        if !self.rng.chance(chance) {
            return;
        }
        let shift = 0.3 * self.rng.signed();
        let uv = self.uv(at + shift, across);
        let heading = if self.rng.chance(0.5) { self.along() } else { -self.along() };
        let frame = self.plan.frame(self.terrain, uv, heading);
        let kind = props::any_vehicle(self.rng);
        props::vehicle(self.mesh, &frame, kind, self.palette, self.rng);
    }

    fn drive(&mut self, at: f32, across: f32, side: f32) {
        let frame = self.plan.frame(self.terrain, self.uv(at, across), self.along() * side);
        let kind = if self.rng.chance(0.15) { Vehicle::Lorry } else { props::any_vehicle(self.rng) };
        props::vehicle(self.mesh, &frame, kind, self.palette, self.rng);
    }

    fn street_tree(&mut self, at: f32, across: f32) {
        if !self.rng.chance(0.7) {
            return;
        }
        let uv = self.uv(at, across);
        let frame = self.plan.frame(self.terrain, uv, self.along());
        let height = self.rng.range(5.0, 8.0);
        tree::tree(self.mesh, &frame, Habit::Broad, height, self.plan.detail(uv), self.palette, self.rng);
    }
}
