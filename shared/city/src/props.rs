//! Small objects: vehicles, lamps, benches, fences and the like.

use glam::{Vec2, Vec3};

use super::mesh::Mesh;
use super::palette::Palette;
use super::random::Rng;
use super::shapes::{Block3, Frame, regular_polygon};

/// A kind of road vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Vehicle {
    Car,
    Van,
    Lorry,
}

/// A random kind of vehicle: mostly cars.
pub(super) fn any_vehicle(rng: &mut Rng) -> Vehicle {
    if rng.chance(0.86) { Vehicle::Car } else { Vehicle::Van }
}

/// Adds a vehicle at a frame's origin, heading along x.
pub(super) fn vehicle(mesh: &mut Mesh, frame: &Frame, kind: Vehicle, palette: &Palette, rng: &mut Rng) {
    let paint = rng.pick(&palette.paints);
    match kind {
        Vehicle::Car => car(mesh, frame, paint, palette, rng),
        Vehicle::Van => {
            let (half, width, high) = (2.6, 0.98, 2.1);
            wheels(mesh, frame, half * 0.64, width, palette);
            hull(mesh, frame, &[(-half, 0.3), (half, 0.3), (half, 0.95), (half - 0.75, 1.15)], width, paint);
            let roof = [(-half, 1.0), (half - 0.8, 1.1), (half - 1.35, high), (-half + 0.05, high)];
            hull(mesh, frame, &roof, width - 0.04, paint);
            screen(mesh, frame, [half - 0.78, 1.16], [half - 1.33, high - 0.12], width - 0.12, palette.glass);
            hull(
                mesh,
                frame,
                &[(-half, 0.3), (half - 0.74, 0.3), (half - 0.74, 1.12), (-half, 1.2)],
                width,
                paint,
            );
        }
        Vehicle::Lorry => {
            wheels(mesh, frame, 2.9, 1.1, palette);
            let load = rng.pick(&palette.stripes);
            let body = Block3 { min: Vec3::new(-4.2, -1.22, 0.9), max: Vec3::new(2.2, 1.22, 3.4) };
            mesh.block(frame, body, load, palette.white);
            let cab = Block3 { min: Vec3::new(2.4, -1.15, 0.45), max: Vec3::new(4.2, 1.15, 2.7) };
            mesh.block(frame, cab, paint, paint);
            screen(mesh, frame, [4.22, 1.5], [4.21, 2.5], 1.0, palette.glass);
        }
    }
}

fn car(mesh: &mut Mesh, frame: &Frame, paint: u32, palette: &Palette, rng: &mut Rng) {
    let half = rng.range(1.9, 2.3);
    let (width, waist, high) = (rng.range(0.84, 0.92), 0.86, rng.range(1.38, 1.62));
    let estate = rng.chance(0.4);
    wheels(mesh, frame, half * 0.62, width, palette);
    let body = [
        (-half, 0.28),
        (half, 0.28),
        (half + 0.04, 0.6),
        (half - 0.12, 0.74),
        (half * 0.42, waist),
        (-half * 0.72, waist),
        (-half + 0.02, 0.8),
    ];
    hull(mesh, frame, &body, width, paint);
    let rear = if estate { -half * 0.93 } else { -half * 0.68 };
    let (front_top, rear_top) = (half * 0.08, rear + if estate { 0.22 } else { 0.55 });
    // The cabin: glass on all sides, narrower at the top, under a painted roof.
    let (low, top) = (width - 0.03, width - 0.2);
    let lower = [(half * 0.44, -low), (half * 0.44, low), (rear, low), (rear, -low)];
    let upper = [(front_top, -top), (front_top, top), (rear_top, top), (rear_top, -top)];
    for i in 0..4 {
        let j = (i + 1) % 4;
        let at = |p: (f32, f32), z: f32| frame.at(p.0, p.1, z);
        mesh.quad(
            [at(lower[i], waist), at(lower[j], waist), at(upper[j], high), at(upper[i], high)],
            [Vec2::ZERO; 4],
            palette.glass,
        );
    }
    let roof = Block3 {
        min: Vec3::new(rear_top - 0.03, -top - 0.03, high - 0.05),
        max: Vec3::new(front_top + 0.03, top + 0.03, high + 0.03),
    };
    mesh.block(frame, roof, paint, paint);
}

/// Adds a body of constant width with a convex side view, given counter-clockwise from the lower rear.
fn hull(mesh: &mut Mesh, frame: &Frame, profile: &[(f32, f32)], half_width: f32, material: u32) {
    let at = |i: usize, side: f32| {
        let (x, z) = profile[i % profile.len()];
        frame.at(x, side * half_width, z)
    };
    for i in 0..profile.len() {
        mesh.quad([at(i, -1.0), at(i + 1, -1.0), at(i + 1, 1.0), at(i, 1.0)], [Vec2::ZERO; 4], material);
    }
    for side in [-1.0, 1.0] {
        for i in 1..profile.len() - 1 {
            mesh.triangle([at(0, side), at(i, side), at(i + 1, side)], [Vec2::ZERO; 3], material);
        }
    }
}

/// Adds a pane across the vehicle between `low` and `high`, each `(x, z)`.
fn screen(mesh: &mut Mesh, frame: &Frame, low: [f32; 2], high: [f32; 2], half_width: f32, glass: u32) {
    let lift = 0.02;
    let corner = frame.at(low[0] + lift, -half_width, low[1]);
    let up = frame.at(high[0] + lift, -half_width, high[1]) - corner;
    mesh.panel(corner, frame.y * (2.0 * half_width), up, glass);
}

fn wheels(mesh: &mut Mesh, frame: &Frame, reach: f32, half_width: f32, palette: &Palette) {
    for x in [-reach, reach] {
        let axle = Block3 {
            min: Vec3::new(x - 0.31, -half_width - 0.02, 0.0),
            max: Vec3::new(x + 0.31, half_width + 0.02, 0.6),
        };
        mesh.block(frame, axle, palette.dark, palette.dark);
    }
}

/// A street lamp whose arm reaches along y.
pub(super) fn lamp(mesh: &mut Mesh, frame: &Frame, palette: &Palette) {
    let height = 6.4;
    mesh.drum(frame, [0.10, 0.06], [-0.2, height], 5, [palette.steel, palette.steel]);
    let arm = Block3 { min: Vec3::new(-0.04, 0.0, height - 0.1), max: Vec3::new(0.04, 1.5, height) };
    mesh.hanging_block(frame, arm, palette.steel);
    let head = Block3 { min: Vec3::new(-0.16, 1.1, height - 0.22), max: Vec3::new(0.16, 1.9, height - 0.06) };
    mesh.hanging_block(frame, head, palette.white);
}

/// A pole with cross arms, for country roads.
pub(super) fn pole(mesh: &mut Mesh, frame: &Frame, palette: &Palette) {
    mesh.drum(frame, [0.16, 0.11], [-0.3, 8.0], 6, [palette.wood; 2]);
    let arm = Block3 { min: Vec3::new(-0.06, -1.1, 7.3), max: Vec3::new(0.06, 1.1, 7.45) };
    mesh.hanging_block(frame, arm, palette.wood);
}

/// A bench looking along y.
pub(super) fn bench(mesh: &mut Mesh, frame: &Frame, palette: &Palette) {
    let seat = Block3 { min: Vec3::new(-0.9, -0.25, 0.38), max: Vec3::new(0.9, 0.25, 0.46) };
    mesh.hanging_block(frame, seat, palette.wood);
    let back = Block3 { min: Vec3::new(-0.9, -0.3, 0.5), max: Vec3::new(0.9, -0.24, 0.9) };
    mesh.hanging_block(frame, back, palette.wood);
    for x in [-0.7, 0.7] {
        let leg = Block3 { min: Vec3::new(x - 0.06, -0.28, -0.1), max: Vec3::new(x + 0.06, 0.2, 0.38) };
        mesh.block(frame, leg, palette.dark, palette.dark);
    }
}

/// A market stall under an awning.
pub(super) fn stall(mesh: &mut Mesh, frame: &Frame, palette: &Palette, rng: &mut Rng) {
    let cloth = rng.pick(&palette.stripes);
    let (w, d) = (rng.range(2.6, 4.0), 2.4);
    let ridge = frame.at(-0.5 * w, 0.0, 2.9);
    for side in [-1.0, 1.0] {
        let eave = frame.at(-0.5 * w, side * 0.5 * d, 2.2);
        mesh.panel(eave, frame.x * w, ridge - eave, cloth);
    }
    let table = Block3::standing(0.0, -0.4, 0.0, Vec3::new(w - 0.5, 0.9, 0.85));
    let goods = rng.pick(&palette.leaves);
    mesh.block(frame, table, palette.wood, if rng.chance(0.5) { palette.straw } else { goods });
    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
        let post = Block3::standing(x * 0.48 * w, y * 0.46 * d, 0.0, Vec3::new(0.08, 0.08, 2.25));
        mesh.block(frame, post, palette.steel, palette.steel);
    }
}

/// A fountain: a round basin with a smaller basin above its centre.
pub(super) fn fountain(mesh: &mut Mesh, frame: &Frame, palette: &Palette) {
    mesh.drum(frame, [3.6, 3.5], [-0.4, 0.55], 14, [palette.stone, palette.stone]);
    mesh.drum(frame, [3.1, 3.1], [0.5, 0.58], 14, [palette.stone, palette.water]);
    mesh.drum(frame, [0.7, 0.5], [0.5, 1.6], 8, [palette.stone, palette.stone]);
    mesh.drum(frame, [0.6, 1.4], [1.5, 1.8], 10, [palette.stone, palette.water]);
    mesh.drum(frame, [0.3, 0.2], [1.7, 2.7], 7, [palette.stone, palette.stone]);
}

/// A shipping container.
pub(super) fn container(mesh: &mut Mesh, frame: &Frame, palette: &Palette, rng: &mut Rng) {
    let side = if rng.chance(0.5) { rng.pick(&palette.stripes) } else { rng.pick(&palette.paints) };
    mesh.block(frame, Block3::standing(0.0, 0.0, 0.0, Vec3::new(6.0, 2.4, 2.6)), side, side);
}

/// A bale of straw lying on its side.
pub(super) fn bale(mesh: &mut Mesh, frame: &Frame, palette: &Palette) {
    let lying = Frame { x: frame.x, y: Vec3::Z, origin: frame.at(0.0, 0.0, 0.62) };
    let ring = regular_polygon(10);
    let (front, back) = (frame.y * -0.6, frame.y * 0.6);
    let at = |p: Vec2, side: Vec3| lying.origin + (lying.x * p.x + lying.y * p.y) * 0.65 + side;
    for i in 0..ring.len() {
        let (a, b) = (ring[i], ring[(i + 1) % ring.len()]);
        mesh.quad([at(a, front), at(b, front), at(b, back), at(a, back)], [Vec2::ZERO; 4], palette.straw);
        for side in [front, back] {
            mesh.triangle([lying.origin + side, at(a, side), at(b, side)], [Vec2::ZERO; 3], palette.straw);
        }
    }
}

/// A climbing frame, a slide and a swing.
pub(super) fn playground(mesh: &mut Mesh, frame: &Frame, palette: &Palette, rng: &mut Rng) {
    let tower = Block3::standing(0.0, 0.0, 1.3, Vec3::new(1.5, 1.5, 0.9));
    mesh.hanging_block(frame, tower, palette.wood);
    for (x, y) in [(-0.7, -0.7), (0.7, -0.7), (0.7, 0.7), (-0.7, 0.7)] {
        let post = Block3::standing(x, y, 0.0, Vec3::new(0.12, 0.12, 3.0));
        mesh.block(frame, post, palette.wood, palette.wood);
    }
    mesh.drum(&frame.moved(0.0, 0.0, 3.0), [1.3, 0.0], [0.0, 0.9], 4, [rng.pick(&palette.stripes); 2]);
    let chute = frame.at(0.75, -0.35, 1.4);
    mesh.panel(chute, frame.y * 0.7, frame.x * 2.6 - Vec3::Z * 1.2, rng.pick(&palette.paints));
    for x in [-5.0, -2.6] {
        let post = Block3::standing(x, 0.0, 0.0, Vec3::new(0.12, 0.12, 2.3));
        mesh.block(frame, post, palette.steel, palette.steel);
    }
    let bar = Block3 { min: Vec3::new(-5.0, -0.06, 2.25), max: Vec3::new(-2.6, 0.06, 2.37) };
    mesh.hanging_block(frame, bar, palette.steel);
}

/// A straight fence or wall between two points on the ground.
pub(super) fn barrier(mesh: &mut Mesh, from: Vec3, to: Vec3, height_m: f32, thickness_m: f32, material: u32) {
    let along = (to - from).with_z(0.0);
    let across = along.truncate().perp().normalize_or_zero().extend(0.0) * (0.5 * thickness_m);
    let (up, slope) = (Vec3::Z * (height_m + 0.3), to - from);
    let foot = from - Vec3::Z * 0.3;
    mesh.panel(foot - across, slope, up, material);
    mesh.panel(foot + across, slope, up, material);
    mesh.panel(foot - across + up, slope, across * 2.0, material);
    mesh.panel(foot - across, across * 2.0, up, material);
    mesh.panel(foot - across + slope, across * 2.0, up, material);
}
