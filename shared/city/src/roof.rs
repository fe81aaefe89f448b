//! Steep roofs: gables, hips, mansards, sawteeth, spires, dormers.

use glam::{Vec2, Vec3};

use super::building::{Footprint, Style};
use super::mesh::Mesh;
use super::palette::Palette;
use super::random::Rng;
use super::shapes::{Block3, Frame};

/// Overhang of eaves beyond the walls, metres.
const EAVES_M: f32 = 0.55;
/// Thickness of a roof, metres.
const THICKNESS_M: f32 = 0.2;

/// Adds a gabled roof whose ridge runs along x, and the gables above the walls, which end at `z_m`.
pub(super) fn gabled(
    mesh: &mut Mesh,
    frame: &Frame,
    part: &Footprint,
    z_m: f32,
    pitch: f32,
    style: &Style,
    rng: &mut Rng,
) {
    let (size, center) = (part.size(), part.center());
    let frame = frame.moved(center.x, center.y, z_m);
    let half = size * 0.5;
    let rise = pitch * half.y;
    for side in [-1.0, 1.0] {
        gable(mesh, &frame, half, side, rise, z_m, style, rng);
        slope(mesh, &frame, half, side, pitch, style);
    }
}

#[allow(clippy::too_many_arguments)]
fn gable(
    mesh: &mut Mesh,
    frame: &Frame,
    half: Vec2,
    side: f32,
    rise: f32,
    z_m: f32,
    style: &Style,
    rng: &mut Rng,
) {
    let bays = (2.0 * half.y / style.bay_m + 0.5).max(1.0) as u32 as f32;
    let (first, floor) = (rng.index(64) as f32 * 16.0, z_m / style.floor_m);
    mesh.triangle(
        [
            frame.at(side * half.x, -half.y, 0.0),
            frame.at(side * half.x, half.y, 0.0),
            frame.at(side * half.x, 0.0, rise),
        ],
        [
            Vec2::new(first, floor),
            Vec2::new(first + bays, floor),
            Vec2::new(first + 0.5 * bays, floor + rise / style.floor_m),
        ],
        style.facade,
    );
}

/// Adds one side of a gabled roof: a slab with eaves and verges.
fn slope(mesh: &mut Mesh, frame: &Frame, half: Vec2, side: f32, pitch: f32, style: &Style) {
    let (x, y) = (half.x + EAVES_M * 0.7, side * (half.y + EAVES_M));
    let (low, high) = (-pitch * EAVES_M, pitch * half.y);
    let t = THICKNESS_M;
    let eave = frame.at(-x, y, low + t);
    let along = frame.x * (2.0 * x);
    let up = frame.at(-x, 0.0, high + t) - eave;
    let down = Vec3::NEG_Z * t;
    mesh.panel(eave, along, up, style.roof);
    mesh.panel(eave + down, up, along, style.trim);
    mesh.panel(eave, along, down, style.trim);
    mesh.panel(eave, up, down, style.trim);
    mesh.panel(eave + along, up, down, style.trim);
}

/// Adds a hipped roof with the same pitch on all four sides; over a square it is a pyramid.
pub(super) fn hipped(mesh: &mut Mesh, frame: &Frame, part: &Footprint, z_m: f32, pitch: f32, style: &Style) {
    let (size, center) = (part.size(), part.center());
    let turned = size.y > size.x;
    let mut frame = frame.moved(center.x, center.y, z_m);
    let mut half = size * 0.5 + EAVES_M;
    if turned {
        frame = frame.turned(Vec2::Y);
        half = Vec2::new(half.y, half.x);
    }
    let low = -pitch * EAVES_M;
    let high = low + pitch * half.y;
    let ridge = half.x - half.y;
    let t = Vec3::Z * THICKNESS_M;
    let corner = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
        .map(|(x, y)| frame.at(x * half.x, y * half.y, low) + t);
    let peaks = [frame.at(-ridge, 0.0, high) + t, frame.at(ridge, 0.0, high) + t];
    let slant = Vec2::new(half.y, high - low).length();
    let long = [
        Vec2::ZERO,
        Vec2::new(2.0 * half.x, 0.0),
        Vec2::new(half.x + ridge, slant),
        Vec2::new(half.x - ridge, slant),
    ];
    mesh.quad([corner[0], corner[1], peaks[1], peaks[0]], long, style.roof);
    mesh.quad([corner[2], corner[3], peaks[0], peaks[1]], long, style.roof);
    let short = [Vec2::ZERO, Vec2::new(2.0 * half.y, 0.0), Vec2::new(half.y, slant)];
    mesh.triangle([corner[1], corner[2], peaks[1]], short, style.roof);
    mesh.triangle([corner[3], corner[0], peaks[0]], short, style.roof);
    for i in 0..4 {
        mesh.panel(corner[i], corner[(i + 1) % 4] - corner[i], -t, style.trim);
    }
    mesh.panel(corner[0] - t, corner[3] - corner[0], corner[1] - corner[0], style.trim);
}

/// Adds a mansard: a steep storey that narrows to a flat top. Returns the footprint of the top.
pub(super) fn mansard(
    mesh: &mut Mesh,
    frame: &Frame,
    part: &Footprint,
    z_m: f32,
    height_m: f32,
    style: &Style,
) -> Footprint {
    let top = part.inset(0.42 * height_m);
    let (low, high) = (part.inset(-0.25).outline(), top.outline());
    for i in 0..4 {
        let j = (i + 1) % 4;
        let (length, slant) = (low[i].distance(low[j]), 1.085 * height_m);
        let inset = 0.42 * height_m + 0.25;
        mesh.quad(
            [
                frame.at(low[i].x, low[i].y, z_m),
                frame.at(low[j].x, low[j].y, z_m),
                frame.at(high[j].x, high[j].y, z_m + height_m),
                frame.at(high[i].x, high[i].y, z_m + height_m),
            ],
            [Vec2::ZERO, Vec2::new(length, 0.0), Vec2::new(length - inset, slant), Vec2::new(inset, slant)],
            style.roof,
        );
    }
    let cornice = part.inset(-0.3);
    let size = cornice.size();
    let band = Block3 { min: cornice.min.extend(z_m - 0.3), max: (cornice.min + size).extend(z_m + 0.02) };
    mesh.hanging_block(frame, band, style.trim);
    top
}

/// Adds a sawtooth roof over the whole part: teeth along x, each with a glazed upright side.
pub(super) fn sawtooth(
    mesh: &mut Mesh,
    frame: &Frame,
    part: &Footprint,
    z_m: f32,
    style: &Style,
    palette: &Palette,
) {
    let size = part.size();
    let teeth = ((size.x / 6.5) as usize).max(1);
    let (step, rise) = (size.x / teeth as f32, 2.3);
    for tooth in 0..teeth {
        let x = part.min.x + step * tooth as f32;
        let foot = frame.at(x, part.min.y, z_m);
        let (across, along, up) = (frame.x * step, frame.y * size.y, Vec3::Z * rise);
        mesh.panel(foot, along, across + up, style.roof);
        mesh.panel(foot + across, along, up * 0.3, style.trim);
        mesh.panel(foot + across + up * 0.3, along, up * 0.7, palette.glass);
        for end in [foot, foot + along] {
            let uv = [Vec2::ZERO, Vec2::X * step, Vec2::new(step, rise)];
            mesh.triangle([end, end + across, end + across + up], uv, style.trim);
        }
    }
}

/// Adds a dormer to the slope that rises towards +y, with its front at local `y_m` and the foot of the front at `z_m`.
pub(super) fn dormer(mesh: &mut Mesh, frame: &Frame, x_m: f32, y_m: f32, z_m: f32, style: &Style) {
    let (half, height, depth) = (0.75, 1.5, 2.6);
    let front = frame.at(x_m - half, y_m, z_m);
    let (across, up, back) = (frame.x * (2.0 * half), Vec3::Z * height, frame.y * depth);
    let floor = 3.0;
    mesh.quad(
        [front, front + across, front + across + up, front + up],
        [
            Vec2::new(0.1, floor + 0.22),
            Vec2::new(0.9, floor + 0.22),
            Vec2::new(0.9, floor + 0.88),
            Vec2::new(0.1, floor + 0.88),
        ],
        style.facade,
    );
    mesh.panel(front, back, up, style.trim);
    mesh.panel(front + across, back, up, style.trim);
    let ridge = Vec3::Z * 0.6;
    let middle = across * 0.5;
    let overhang = frame.y * -0.2;
    let uv = [Vec2::ZERO, Vec2::X * 1.5, Vec2::new(0.75, 0.6)];
    mesh.triangle([front + up, front + across + up, front + up + middle + ridge], uv, style.trim);
    let eave = frame.x * 0.15 + Vec3::Z * 0.12;
    let reach = back - overhang;
    mesh.panel(
        front + up - frame.x * 0.15 - Vec3::Z * 0.12 + overhang,
        reach,
        middle + ridge + eave,
        style.roof,
    );
    mesh.panel(
        front + up + across + frame.x * 0.15 - Vec3::Z * 0.12 + overhang,
        reach,
        -middle + ridge - frame.x * 0.15 + Vec3::Z * 0.12,
        style.roof,
    );
}
