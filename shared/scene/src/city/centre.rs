//! The blocks of the centre: closed rows of houses, the church square, towers, apartment houses.

use glam::{Vec2, Vec3};

use super::building::{self, Footprint, Lot, Style};
use super::facade::{Facade, Wall};
use super::material::Material;
use super::mesh::Block3;
use super::paving::{Outline, PAVEMENT_M, Surface};
use super::props;
use super::roof;
use super::roofing::Cover;
use super::site::{Side, Site};
use super::tree::Habit;

/// Houses wall to wall along all four sides, with a courtyard.
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
        // Two sides take the corners, the others fill in between.
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

/// A house of a row: the ridge follows the street.
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
            roof_life(site, &lot, &part, top_m, pitch, &style);
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

/// Chimneys, dormers and solar panels of a gabled roof.
fn roof_life(site: &mut Site, lot: &Lot, part: &Footprint, top_m: f32, pitch: f32, style: &Style) {
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
            shed(site, uv, along, size_m);
        }
    }
    let area = size.x * size.y;
    site.scatter((area / 55.0) as usize + 2, &[Habit::Broad, Habit::Broad, Habit::Bush], (3.0, 9.5));
}

/// A low outbuilding.
pub(super) fn shed(site: &mut Site, uv: Vec2, along: Vec2, size_m: Vec2) {
    let cover = if site.rng.chance(0.5) { Cover::Felt } else { Cover::Sheet };
    let style = Style::random(site.mesh, &mut site.rng, Wall::Boards, cover, false);
    let lot = site.lot(uv, along, size_m);
    let part = Footprint::around(0.0, 0.0, size_m);
    let height = site.rng.range(2.2, 2.8);
    building::walls(site.mesh, &lot, &part.outline(), height, &style, &mut site.rng);
    if site.rng.chance(0.5) {
        roof::gabled(site.mesh, &lot.frame, &part, height, 0.5, &style, &mut site.rng);
    } else {
        let roof = part.inset(-0.25);
        let lid = Block3 { min: roof.min.extend(height), max: roof.max.extend(height + 0.16) };
        site.mesh.block(&lot.frame, lid, style.trim, style.roof);
    }
}

/// A church, a fountain, stalls and trees on a paved square.
pub(super) fn plaza(site: &mut Site) {
    let size = site.size();
    let turned = size.y > size.x;
    let (along, long, short) = if turned { (Vec2::Y, size.y, size.x) } else { (Vec2::X, size.x, size.y) };
    let nave = Vec2::new((0.42 * long).clamp(13.0, 26.0), (0.24 * short).clamp(7.5, 12.0));
    let uv = site.center() - along * (0.5 * long - 0.5 * nave.x - 8.5) + along.perp() * (0.16 * short);
    church(site, uv, along, nave);
    let square = site.center() + along * (0.22 * long);
    let fountain = square - along.perp() * (0.08 * short);
    let frame = site.frame(fountain, along);
    props::fountain(site.mesh, &frame, site.palette);
    site.reserve((fountain - 5.0, fountain + 5.0));
    site.cover(Outline::Ring(fountain, 5.4, 1.0), Surface::Flags(0.5));
    for i in 0..(long * short / 230.0) as usize {
        if let Some(uv) = site.free_spot(2.6) {
            let frame = site.frame(uv, if i % 2 == 0 { along } else { along.perp() });
            props::stall(site.mesh, &frame, site.palette, &mut site.rng);
            site.reserve((uv - 2.2, uv + 2.2));
        }
    }
    avenue(site, 8.5, 5.5);
    for _ in 0..8 {
        if let Some(uv) = site.free_spot(1.0) {
            let frame = site.frame(uv, along);
            props::bench(site.mesh, &frame, site.palette);
        }
    }
}

/// Trees in line just inside the pavement.
fn avenue(site: &mut Site, every_m: f32, height_m: f32) {
    for side in site.sides() {
        let count = ((side.length_m - 10.0) / every_m).max(0.0) as usize;
        for i in 0..count {
            let uv = side.at(5.0 + every_m * (i as f32 + 0.5), PAVEMENT_M + 2.0);
            if site.is_free(uv, 1.5) && site.rng.chance(0.8) {
                let height = height_m * site.rng.range(0.85, 1.35);
                site.plant(uv, Habit::Broad, height);
            }
        }
    }
}

fn church(site: &mut Site, uv: Vec2, along: Vec2, nave: Vec2) {
    let cover = if site.rng.chance(0.5) { Cover::Slate } else { Cover::Tiles };
    let style = Style::random(site.mesh, &mut site.rng, Wall::Stone, cover, false);
    let lot = site.lot(uv, along, nave + Vec2::new(8.0, 5.0));
    let height = 7.4;
    let body = Footprint::around(0.0, 0.0, nave);
    building::walls(site.mesh, &lot, &body.outline(), height, &style, &mut site.rng);
    roof::gabled(site.mesh, &lot.frame, &body, height, 1.15, &style, &mut site.rng);
    // A transept and a choir.
    let transept = lot.frame.moved(0.18 * nave.x, 0.0, 0.0).turned(Vec2::Y);
    let arm = Footprint::around(0.0, 0.0, Vec2::new(nave.y + 6.0, 6.0));
    let arm_lot = Lot { frame: transept, ..lot };
    building::walls(site.mesh, &arm_lot, &arm.outline(), height, &style, &mut site.rng);
    roof::gabled(site.mesh, &transept, &arm, height, 1.15, &style, &mut site.rng);
    // The tower at the west end.
    let side = 5.4;
    let tower = Footprint::around(-0.5 * nave.x - 0.3 * side, 0.0, Vec2::splat(side));
    let tower_height = site.rng.range(15.0, 19.0);
    building::walls(site.mesh, &lot, &tower.outline(), tower_height, &style, &mut site.rng);
    roof::hipped(site.mesh, &lot.frame, &tower, tower_height, 2.6, &style);
    let c = tower.center();
    let cross = lot.frame.moved(c.x, c.y, tower_height + 2.6 * 0.5 * side);
    site.mesh.drum(&cross, [0.12, 0.05], [-0.5, 2.2], 5, [site.palette.dark; 2]);
}

/// Towers with setbacks on a shared podium.
pub(super) fn towers(site: &mut Site) {
    let size = site.size();
    let turned = size.y > size.x;
    let (along, long, short) = if turned { (Vec2::Y, size.y, size.x) } else { (Vec2::X, size.x, size.y) };
    let room = Vec2::new(long, short) - 2.0 * (PAVEMENT_M + 3.0);
    let count = if room.x > 34.0 { 2 } else { 1 };
    site.cover(Outline::Disc(site.center(), 0.2 * short), Surface::Cobbles);
    for i in 0..count {
        let shift = (i as f32 - 0.5 * (count - 1) as f32) * room.x / count as f32;
        let side_step = site.rng.signed() * 0.10 * room.y;
        let uv = site.center() + along * shift + along.perp() * side_step;
        let base = Vec2::new((0.74 * room.x / count as f32).min(24.0), (0.66 * room.y).min(24.0));
        stepped_tower(site, uv, along, base, i);
    }
    avenue(site, 7.0, 6.0);
    let beds = [Vec2::new(0.3, 0.12), Vec2::new(0.7, 0.88), Vec2::new(0.12, 0.7)];
    for bed in beds {
        let uv = site.block.min + size * bed;
        site.cover(Outline::Disc(uv, 2.6), Surface::Lawn);
        if site.is_free(uv, 1.0) {
            site.plant(uv, Habit::Bush, 1.8);
        }
    }
}

fn stepped_tower(site: &mut Site, uv: Vec2, along: Vec2, base: Vec2, which: usize) {
    let walls = [Wall::Curtain, Wall::Panels, Wall::Brick];
    let wall = walls[(which + site.block.seed as usize) % 3];
    let cover = site.flat_cover();
    let style = Style::random(site.mesh, &mut site.rng, wall, cover, false);
    let podium_style = Style::random(site.mesh, &mut site.rng, Wall::Panels, Cover::Gravel, true);
    let lot = site.lot(uv, along, base);
    let podium = Footprint::around(0.0, 0.0, base);
    let mut height = podium_style.height_m(1 + site.rng.index(2) as u32) + 0.4;
    building::walls(site.mesh, &lot, &podium.outline(), height, &podium_style, &mut site.rng);
    building::flat_roof(site.mesh, &lot.frame, &podium.outline(), &[podium], height, &podium_style);
    let steps = 2 + site.rng.index(2);
    let mut part = podium.inset(1.8);
    for step in 0..steps {
        let floors = 2 + site.rng.index(3) as u32;
        let top = height + style.height_m(floors) + 0.3;
        building::raised_walls(site.mesh, &lot.frame, &part.outline(), [height, top], &style, &mut site.rng);
        building::flat_roof(site.mesh, &lot.frame, &part.outline(), &[part], top, &style);
        height = top;
        if step + 1 < steps {
            let shift = Vec2::new(site.rng.range(0.0, 0.22), site.rng.range(0.0, 0.22)) * part.size();
            let (low, high) = (part.min + shift * 0.7, part.max - shift * site.rng.range(0.4, 1.0) - 0.8);
            part = Footprint { min: low, max: high };
        }
    }
    building::roof_clutter(site.mesh, &lot.frame, &part, height, &style, site.palette, &mut site.rng);
    let c = part.center();
    let mast = lot.frame.moved(c.x, c.y, height);
    site.mesh.drum(&mast, [0.12, 0.04], [0.0, 5.5], 5, [site.palette.steel; 2]);
}

/// Two long apartment houses with lawns and a car park between.
pub(super) fn slabs(site: &mut Site) {
    let size = site.size();
    let turned = size.y > size.x;
    let (along, long, short) = if turned { (Vec2::Y, size.y, size.x) } else { (Vec2::X, size.x, size.y) };
    let depth = 10.5;
    let length = (long - 2.0 * (PAVEMENT_M + 4.0)).min(48.0);
    for (i, side) in [-1.0, 1.0].into_iter().enumerate() {
        let off = 0.5 * short - PAVEMENT_M - 3.0 - 0.5 * depth;
        let uv = site.center() + along.perp() * (side * off);
        if i == 0 || off > 9.0 {
            let facing = if side > 0.0 { -along } else { along };
            apartment_house(site, uv, facing, Vec2::new(length, depth));
        }
    }
    let park = (
        site.center() - along * (0.3 * long) - along.perp() * 2.6,
        site.center() + along * (0.1 * long) + along.perp() * 2.6,
    );
    let park = (park.0.min(park.1), park.0.max(park.1));
    site.cover_rectangle(park, Surface::CarPark(turned));
    site.reserve(park);
    for i in 0..((park.1 - park.0).max_element() / 2.5) as usize {
        if site.rng.chance(0.6) {
            let uv = site.center() - along * (0.3 * long - 2.5 * (i as f32 + 0.5));
            let frame = site.frame(uv, along.perp());
            let kind = props::any_vehicle(&mut site.rng);
            props::vehicle(site.mesh, &frame, kind, site.palette, &mut site.rng);
        }
    }
    let play = site.center() + along * (0.28 * long);
    site.cover(Outline::Disc(play, 4.6), Surface::Sand);
    let frame = site.frame(play, along);
    props::playground(site.mesh, &frame, site.palette, &mut site.rng);
    site.reserve((play - 4.5, play + 4.5));
    site.scatter(
        (long * short / 110.0) as usize,
        &[Habit::Broad, Habit::Broad, Habit::Conifer, Habit::Bush],
        (3.0, 12.0),
    );
}

fn apartment_house(site: &mut Site, uv: Vec2, along: Vec2, size_m: Vec2) {
    let wall = if site.rng.chance(0.6) { Wall::Panels } else { Wall::Plaster };
    let cover = site.flat_cover();
    let style = Style::random(site.mesh, &mut site.rng, wall, cover, false);
    let floors = 3 + site.rng.index(3) as u32;
    // An L now and then: a wing towards the garden side, y < 0 being the balcony side.
    let lot = site.lot(uv, along, size_m);
    let main = Footprint::around(0.0, 0.0, size_m);
    let top_m = style.height_m(floors) + 0.4;
    building::walls(site.mesh, &lot, &main.outline(), top_m, &style, &mut site.rng);
    building::flat_roof(site.mesh, &lot.frame, &main.outline(), &[main], top_m, &style);
    building::roof_clutter(site.mesh, &lot.frame, &main, top_m, &style, site.palette, &mut site.rng);
    let columns = (size_m.x / 7.0) as usize;
    for column in 0..columns {
        let x = (column as f32 + 0.5 - 0.5 * columns as f32) * 7.0;
        for floor in 1..floors {
            let z = style.height_m(floor);
            building::balcony(site.mesh, &lot.frame, x, -0.5 * size_m.y, z, &style);
        }
    }
}

/// A facade for a school or hall: the given wall with this share of windows.
pub(super) fn hall_style(site: &mut Site, wall: Wall, cover: Cover, windows: f32) -> Style {
    let style = Style::random(site.mesh, &mut site.rng, wall, cover, false);
    let facade =
        Facade { windows, bay_m: style.bay_m, floor_m: style.floor_m, ..Facade::random(wall, &mut site.rng) };
    Style { facade: site.mesh.add(Material::Facade(facade)), ..style }
}
