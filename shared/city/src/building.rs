//! Buildings: walls on a footprint, flat roofs and the objects on them.

use glam::{Vec2, Vec3};

use super::facade::{Facade, Wall};
use super::material::Material;
use super::mesh::Mesh;
use super::palette::Palette;
use super::random::Rng;
use super::roofing::{Cover, Roofing};
use super::shapes::{Block3, Frame};

/// The site of a building.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lot {
    /// Frame of the ground floor.
    pub(super) frame: Frame,
    /// Depth from the floor to below the lowest ground around, metres.
    pub(super) depth_m: f32,
}

/// The materials and dimensions of one building.
#[derive(Clone, Copy, Debug)]
pub(super) struct Style {
    pub(super) facade: u32,
    pub(super) roof: u32,
    /// Eaves, parapets, balconies.
    pub(super) trim: u32,
    pub(super) plinth: u32,
    pub(super) bay_m: f32,
    pub(super) floor_m: f32,
}

impl Style {
    /// A random style with these walls and this roof cover.
    pub(super) fn random(mesh: &mut Mesh, rng: &mut Rng, wall: Wall, cover: Cover, shops: bool) -> Self {
        let facade = Facade { shops, ..Facade::random(wall, rng) };
        let (bay_m, floor_m, trim) = (facade.bay_m, facade.floor_m, facade.trim);
        let roofing = Roofing::random(cover, rng);
        let plain = |albedo, contrast, seed| Material::Plain { albedo, contrast, seed };
        Self {
            trim: mesh.add(plain(trim * 0.8, 0.18, rng.seed())),
            plinth: mesh.add(plain(Vec3::new(0.22, 0.205, 0.185), 0.25, rng.seed())),
            facade: mesh.add(Material::Facade(facade)),
            roof: mesh.add(Material::Roofing(roofing)),
            bay_m,
            floor_m,
        }
    }

    /// Height of this many floors, metres.
    pub(super) fn height_m(&self, floors: u32) -> f32 {
        self.floor_m * floors as f32
    }
}

/// A rectangle of a footprint, in the lot's frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Footprint {
    pub(super) min: Vec2,
    pub(super) max: Vec2,
}

impl Footprint {
    /// A rectangle of `size_m` around a point.
    pub(super) fn around(x: f32, y: f32, size_m: Vec2) -> Self {
        Self { min: Vec2::new(x, y) - size_m * 0.5, max: Vec2::new(x, y) + size_m * 0.5 }
    }

    pub(super) fn size(&self) -> Vec2 {
        self.max - self.min
    }

    pub(super) fn center(&self) -> Vec2 {
        (self.min + self.max) * 0.5
    }

    /// This rectangle, smaller by `by_m` on every side.
    pub(super) fn inset(&self, by_m: f32) -> Self {
        Self { min: self.min + by_m, max: self.max - by_m }
    }

    /// Its corners, counter-clockwise.
    pub(super) fn outline(&self) -> [Vec2; 4] {
        [self.min, Vec2::new(self.max.x, self.min.y), self.max, Vec2::new(self.min.x, self.max.y)]
    }
}

/// Adds walls over a counter-clockwise outline from height 0 to `top_m`, and the plinth below them.
pub(super) fn walls(mesh: &mut Mesh, lot: &Lot, outline: &[Vec2], top_m: f32, style: &Style, rng: &mut Rng) {
    raised_walls(mesh, &lot.frame, outline, [0.0, top_m], style, rng);
    for (i, &a) in outline.iter().enumerate() {
        let b = outline[(i + 1) % outline.len()];
        let outward = -(b - a).perp().normalize_or_zero() * 0.06;
        let along = b - a + (b - a).normalize_or_zero() * 0.12;
        let foot = lot.frame.at(
            a.x + outward.x - along.normalize_or_zero().x * 0.06,
            a.y + outward.y - along.normalize_or_zero().y * 0.06,
            -lot.depth_m,
        );
        let side = lot.frame.x * along.x + lot.frame.y * along.y;
        mesh.panel(foot, side, Vec3::Z * (lot.depth_m + 0.25), style.plinth);
    }
}

/// Adds walls over an outline between two heights.
pub(super) fn raised_walls(
    mesh: &mut Mesh,
    frame: &Frame,
    outline: &[Vec2],
    heights_m: [f32; 2],
    style: &Style,
    rng: &mut Rng,
) {
    for (i, &a) in outline.iter().enumerate() {
        let b = outline[(i + 1) % outline.len()];
        let bays = (a.distance(b) / style.bay_m + 0.5).max(1.0) as u32 as f32;
        let first = rng.index(64) as f32 * 16.0;
        let (low, high) = (heights_m[0] / style.floor_m, heights_m[1] / style.floor_m);
        mesh.quad(
            [
                frame.at(a.x, a.y, heights_m[0]),
                frame.at(b.x, b.y, heights_m[0]),
                frame.at(b.x, b.y, heights_m[1]),
                frame.at(a.x, a.y, heights_m[1]),
            ],
            [
                Vec2::new(first, low),
                Vec2::new(first + bays, low),
                Vec2::new(first + bays, high),
                Vec2::new(first, high),
            ],
            style.facade,
        );
    }
}

/// Adds a flat roof at height `z_m` over the parts of a footprint, with a parapet along its outline.
pub(super) fn flat_roof(
    mesh: &mut Mesh,
    frame: &Frame,
    outline: &[Vec2],
    parts: &[Footprint],
    z_m: f32,
    style: &Style,
) {
    for part in parts {
        let size = part.size();
        let corner = frame.at(part.min.x, part.min.y, z_m);
        mesh.panel(corner, frame.x * size.x, frame.y * size.y, style.roof);
    }
    for (i, &a) in outline.iter().enumerate() {
        let b = outline[(i + 1) % outline.len()];
        let along = (b - a).normalize_or_zero();
        let edge = frame.moved(a.x, a.y, z_m).turned(along);
        let parapet =
            Block3 { min: Vec3::new(-0.05, -0.05, -0.15), max: Vec3::new(a.distance(b) + 0.05, 0.3, 0.75) };
        mesh.block(&edge, parapet, style.trim, style.trim);
    }
}

/// Adds boxes, vents, skylights and solar panels to a part of a flat roof.
pub(super) fn roof_clutter(
    mesh: &mut Mesh,
    frame: &Frame,
    part: &Footprint,
    z_m: f32,
    style: &Style,
    palette: &Palette,
    rng: &mut Rng,
) {
    let inner = part.inset(1.3);
    let size = inner.size();
    if size.min_element() < 2.0 {
        return;
    }
    let solar = rng.chance(0.35) && size.min_element() > 4.0;
    if solar {
        solar_rows(mesh, frame, &inner, z_m, palette, rng);
    }
    if size.min_element() > 3.5 && rng.chance(0.75) {
        let (w, d) = (rng.range(2.4, 3.6), rng.range(2.4, 4.2));
        let x = inner.min.x + 0.5 * w + rng.unit() * (size.x - w).max(0.0);
        let y = inner.max.y - 0.5 * d;
        let house = Block3::standing(x, y, z_m, Vec3::new(w, d, rng.range(2.2, 3.0)));
        mesh.block(frame, house, style.trim, style.roof);
    }
    let count = (size.x * size.y / 22.0) as usize + 1;
    for _ in 0..count.min(24) {
        let x = inner.min.x + rng.unit() * size.x;
        let y =
            if solar { inner.max.y - rng.unit() * 0.2 * size.y } else { inner.min.y + rng.unit() * size.y };
        roof_unit(mesh, &frame.moved(x, y, z_m), palette, rng);
    }
}

fn roof_unit(mesh: &mut Mesh, frame: &Frame, palette: &Palette, rng: &mut Rng) {
    match rng.index(5) {
        0 => {
            let radius = rng.range(0.15, 0.35);
            mesh.drum(frame, [radius; 2], [0.0, rng.range(0.5, 1.2)], 7, [palette.steel, palette.dark]);
        }
        1 => {
            let dome = Block3::standing(0.0, 0.0, 0.0, Vec3::new(1.3, 1.3, 0.35));
            mesh.block(frame, dome, palette.white, palette.glass);
        }
        2 => {
            // A duct.
            let length = rng.range(2.0, 5.0);
            let duct = Block3::standing(0.0, 0.0, 0.25, Vec3::new(length, 0.55, 0.5));
            mesh.hanging_block(frame, duct, palette.steel);
        }
        _ => {
            let size = Vec3::new(rng.range(0.9, 2.2), rng.range(0.8, 1.6), rng.range(0.7, 1.5));
            mesh.block(frame, Block3::standing(0.0, 0.0, 0.1, size), palette.steel, palette.steel);
            let fan = frame.moved(0.0, 0.0, size.z + 0.1);
            mesh.drum(&fan, [0.36; 2], [0.0, 0.12], 8, [palette.dark, palette.dark]);
        }
    }
}

fn solar_rows(mesh: &mut Mesh, frame: &Frame, inner: &Footprint, z_m: f32, palette: &Palette, rng: &mut Rng) {
    let size = inner.size();
    let modules = (size.x * rng.range(0.5, 0.95)) as usize;
    let rows = ((size.y * 0.75 / 2.4) as usize).min(12);
    for row in 0..rows {
        let y = inner.min.y + 2.4 * row as f32;
        let corner = frame.at(inner.min.x, y, z_m + 0.25);
        // Modules 1.65 m long, tilted by about 17 degrees.
        let tilt = frame.y * 1.58 + Vec3::Z * 0.47;
        mesh.panel(corner, frame.x * modules as f32, tilt, palette.solar);
        let back = corner + tilt;
        mesh.panel(back, frame.x * modules as f32, Vec3::NEG_Z * 0.7, palette.steel);
    }
}

/// Adds a chimney between two heights, the lower of them below the roof.
pub(super) fn chimney(mesh: &mut Mesh, frame: &Frame, at: Vec2, heights_m: [f32; 2], palette: &Palette) {
    let shaft = Block3 {
        min: Vec3::new(at.x - 0.35, at.y - 0.3, heights_m[0]),
        max: Vec3::new(at.x + 0.35, at.y + 0.3, heights_m[1]),
    };
    mesh.block(frame, shaft, palette.brick, palette.dark);
    let cap = Block3::standing(at.x, at.y, heights_m[1], Vec3::new(0.9, 0.8, 0.12));
    mesh.hanging_block(frame, cap, palette.concrete);
    mesh.drum(
        &frame.moved(at.x, at.y, heights_m[1]),
        [0.14; 2],
        [0.1, 0.5],
        6,
        [palette.terracotta, palette.dark],
    );
}

/// Adds a balcony with a parapet to the wall at `y = wall_y`, on its side of smaller y.
pub(super) fn balcony(mesh: &mut Mesh, frame: &Frame, x: f32, wall_y: f32, z_m: f32, style: &Style) {
    let slab =
        Block3 { min: Vec3::new(x - 1.5, wall_y - 1.3, z_m - 0.15), max: Vec3::new(x + 1.5, wall_y, z_m) };
    mesh.hanging_block(frame, slab, style.trim);
    for (min, max) in [
        (Vec3::new(x - 1.5, wall_y - 1.3, z_m), Vec3::new(x + 1.5, wall_y - 1.2, z_m + 1.0)),
        (Vec3::new(x - 1.5, wall_y - 1.2, z_m), Vec3::new(x - 1.4, wall_y, z_m + 1.0)),
        (Vec3::new(x + 1.4, wall_y - 1.2, z_m), Vec3::new(x + 1.5, wall_y, z_m + 1.0)),
    ] {
        mesh.block(frame, Block3 { min, max }, style.trim, style.trim);
    }
}
