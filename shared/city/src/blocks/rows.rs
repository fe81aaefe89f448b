//! Terraced houses around a courtyard.

use glam::{Vec2, Vec3};

use super::common;
use super::site::{Side, Site};
use crate::building::{self, Footprint, Lot, Style};
use crate::facade::Wall;
use crate::paving::{Outline, PAVEMENT_M, Surface};
use crate::props;
use crate::roof;
use crate::tree::Habit;

/// Terraced houses along all four sides, with a courtyard.
pub(super) fn perimeter(site: &mut Site) {
    let setback = PAVEMENT_M + 0.2;
    let depth = (0.34 * site.size().min_element() - setback).clamp(6.0, 11.0);
    let court = (site.block.min + setback + depth, site.block.max - setback - depth);
    if (court.1 - court.0).min_element() > 9.0 {
        let (a, b) = court;
        site.cover_rectangle((a + 2.0, b - 2.0), Surface::Lawn);
        site.cover(
            Outline::Strip(a.with_y(0.5 * (a.y + b.y)), b.with_y(0.5 * (a.y + b.y)), 2.2),
            Surface::Flags(0.8),
        );
    }
    for (i, side) in site.sides().into_iter().enumerate() {
        // Two opposite sides include the corners, the other two lie between them.
        let (from, to) = if i % 2 == 0 {
            (setback, side.length_m - setback)
        } else {
            (setback + depth, side.length_m - setback - depth)
        };
        row(site, &side, from, to, setback, depth);
    }
    courtyard(site, court);
}

fn row(site: &mut Site, side: &Side, from: f32, to: f32, setback: f32, depth: f32) {
    let mut at = from;
    while to - at > 5.0 {
        let wanted = site.rng.range(8.5, 17.0);
        let width = if to - at - wanted < 7.0 { to - at } else { wanted };
        if site.rng.chance(0.93) || width < 9.0 {
            let back = site.rng.range(0.0, 0.35);
            let uv = side.at(at + 0.5 * width, setback + back + 0.5 * depth);
            town_house(site, uv, side.along, Vec2::new(width + 0.1, depth));
        } else {
            // A gap with a yard behind a wall.
            let (a, b) = (side.at(at, setback + 0.4), side.at(at + width, setback + 0.4));
            let (a, b) = (site.ground(a), site.ground(b));
            props::barrier(site.mesh, a, b, 2.0, 0.3, site.palette.stone);
            let uv = side.at(at + 0.5 * width, setback + 4.5);
            site.plant(uv, Habit::Broad, 7.5);
        }
        at += width;
    }
}

/// A terraced house, whose ridge follows the street.
fn town_house(site: &mut Site, uv: Vec2, along: Vec2, size_m: Vec2) {
    let floors = 2 + site.rng.index(4) as u32;
    let wall = site.town_wall();
    let wall = if wall == Wall::Stone { Wall::Plaster } else { wall };
    let kind = site.rng.index(10);
    let cover = if kind < 7 { site.steep_cover() } else { site.flat_cover() };
    let shops = site.rng.chance(0.45);
    let style = Style::random(site.mesh, &mut site.rng, wall, cover, shops);
    let lot = site.lot(uv, along, size_m);
    let part = Footprint::around(0.0, 0.0, size_m);
    let top_m = style.height_m(floors) + 0.5;
    building::walls(site.mesh, &lot, &part.outline(), top_m, &style, &mut site.rng);
    match kind {
        0..5 => {
            let pitch = site.rng.range(0.7, 1.05);
            roof::gabled(site.mesh, &lot.frame, &part, top_m, pitch, &style, &mut site.rng);
            roof_details(site, &lot, &part, top_m, pitch, &style);
        }
        5..7 => {
            let height = site.rng.range(2.4, 3.2);
            let top = roof::mansard(site.mesh, &lot.frame, &part, top_m, height, &style);
            let flat = Style { roof: style.plinth, ..style };
            let top_m = top_m + height;
            building::flat_roof(site.mesh, &lot.frame, &[], &[top], top_m, &flat);
            building::roof_clutter(site.mesh, &lot.frame, &top, top_m, &flat, site.palette, &mut site.rng);
            dormers(site, &lot, &part, top_m, 0.9, &style);
        }
        _ => {
            building::flat_roof(site.mesh, &lot.frame, &part.outline(), &[part], top_m, &style);
            building::roof_clutter(site.mesh, &lot.frame, &part, top_m, &style, site.palette, &mut site.rng);
        }
    }
    if shops && site.rng.chance(0.6) {
        awning(site, &lot, &part, &style);
    }
}

/// Adds chimneys, dormers and solar panels to a gabled roof.
fn roof_details(site: &mut Site, lot: &Lot, part: &Footprint, top_m: f32, pitch: f32, style: &Style) {
    let half = part.size() * 0.5;
    let ridge = top_m + pitch * half.y;
    for _ in 0..1 + site.rng.index(2) {
        let at = Vec2::new(site.rng.signed() * 0.8 * half.x, site.rng.signed() * 0.3 * half.y);
        building::chimney(site.mesh, &lot.frame, at, [top_m, ridge + site.rng.range(0.5, 1.0)], site.palette);
    }
    match site.rng.index(4) {
        0 | 1 => dormers(site, lot, part, top_m, pitch, style),
        2 => {
            let up = Vec2::new(1.0, pitch).normalize() * site.rng.range(1.7, 3.3);
            let y = -half.y + 0.8;
            let width = (half.x * site.rng.range(0.7, 1.5)).max(2.0) as u32 as f32;
            let x = site.rng.signed() * (half.x - 0.5 * width).max(0.0) - 0.5 * width;
            let corner = lot.frame.at(x, y, top_m + pitch * 0.8 + 0.36);
            let slope = lot.frame.y * up.x + Vec3::Z * up.y;
            site.mesh.panel(corner, lot.frame.x * width, slope, site.palette.solar);
        }
        _ => {}
    }
}

fn dormers(site: &mut Site, lot: &Lot, part: &Footprint, top_m: f32, pitch: f32, style: &Style) {
    let half = part.size() * 0.5;
    let count = (half.x / 1.9) as usize;
    for (frame, keep) in [(lot.frame, true), (lot.frame.turned(Vec2::NEG_X), site.rng.chance(0.6))] {
        for i in 0..count {
            let x = (i as f32 + 0.5 - 0.5 * count as f32) * 3.6;
            if keep && site.rng.chance(0.85) && x.abs() < half.x - 1.2 {
                roof::dormer(site.mesh, &frame, x, -half.y + 0.6, top_m + 0.5 * pitch + 0.25, style);
            }
        }
    }
}

fn awning(site: &mut Site, lot: &Lot, part: &Footprint, style: &Style) {
    let size = part.size();
    let width = size.x * site.rng.range(0.3, 0.8);
    let z = 0.74 * style.floor_m;
    let corner = lot.frame.at(-0.5 * width, part.min.y - 0.03, z);
    let out = lot.frame.y * -1.6 - Vec3::Z * 0.55;
    let cloth = site.rng.pick(&site.palette.stripes);
    site.mesh.panel(corner, lot.frame.x * width, out, cloth);
}

fn courtyard(site: &mut Site, (min, max): (Vec2, Vec2)) {
    let size = max - min;
    if size.min_element() < 6.0 {
        return;
    }
    for _ in 0..(size.x * size.y / 260.0) as usize + 1 {
        if let Some(uv) = site.free_spot(2.6) {
            let along = if site.rng.chance(0.5) { Vec2::X } else { Vec2::Y };
            let size_m = Vec2::new(site.rng.range(3.5, 7.0), site.rng.range(3.0, 4.0));
            common::shed(site, uv, along, size_m);
        }
    }
    let area = size.x * size.y;
    site.scatter((area / 55.0) as usize + 2, &[Habit::Broad, Habit::Broad, Habit::Bush], (3.0, 9.5));
}
