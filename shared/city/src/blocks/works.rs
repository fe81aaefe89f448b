//! The school with its pitch, and halls with car parks.

use glam::{Vec2, Vec3};

use super::site::Site;
use crate::building::{self, Footprint, Style};
use crate::facade::{Facade, Wall};
use crate::material::Material;
use crate::paving::{Outline, PAVEMENT_M, Surface};
use crate::props;
use crate::roof;
use crate::roofing::Cover;
use crate::shapes::Block3;
use crate::tree::Habit;

/// An L-shaped school with a flat roof, a yard and a pitch.
pub(super) fn school(site: &mut Site) {
    let size = site.size();
    let (a, b) = (site.block.min + PAVEMENT_M + 3.0, site.block.max - PAVEMENT_M - 3.0);
    let room = b - a;
    let cover = site.flat_cover();
    let style = hall_style(site, Wall::Brick, cover, 1.0);
    let reach = Vec2::new(0.52 * room.x, 0.60 * room.y);
    let arm = (0.24 * room.min_element()).clamp(6.5, 10.0);
    let lot = site.lot(a + reach * 0.5, Vec2::X, reach);
    let h = reach * 0.5;
    let outline = [
        Vec2::new(-h.x, -h.y),
        Vec2::new(h.x, -h.y),
        Vec2::new(h.x, -h.y + arm),
        Vec2::new(-h.x + arm, -h.y + arm),
        Vec2::new(-h.x + arm, h.y),
        Vec2::new(-h.x, h.y),
    ];
    let parts = [
        Footprint { min: outline[0], max: outline[2] },
        Footprint { min: Vec2::new(-h.x, -h.y + arm), max: outline[4] },
    ];
    let top_m = style.height_m(2) + 0.4;
    building::walls(site.mesh, &lot, &outline, top_m, &style, &mut site.rng);
    building::flat_roof(site.mesh, &lot.frame, &outline, &parts, top_m, &style);
    for part in &parts {
        building::roof_clutter(site.mesh, &lot.frame, part, top_m, &style, site.palette, &mut site.rng);
    }
    let yard = (a + arm + 1.0, a + reach);
    site.cover_rectangle(yard, Surface::Asphalt);
    let court = ((yard.0 + yard.1) * 0.5, 0.32 * (yard.1 - yard.0).min_element());
    site.cover(Outline::Ring(court.0, court.1, 0.5), Surface::Rubber);
    let pitch = (Vec2::new(a.x + 0.58 * room.x, a.y + 0.08 * room.y), b - 0.06 * room);
    site.cover_rectangle((pitch.0 - 1.5, pitch.1 + 1.5), Surface::Rubber);
    site.cover_rectangle(pitch, Surface::Pitch);
    site.reserve((pitch.0 - 2.0, pitch.1 + 2.0));
    goals(site, pitch);
    site.scatter(
        (size.x * size.y / 120.0) as usize,
        &[Habit::Broad, Habit::Poplar, Habit::Bush],
        (3.0, 11.0),
    );
}

fn goals(site: &mut Site, (min, max): (Vec2, Vec2)) {
    let (center, half) = ((min + max) * 0.5, (max - min) * 0.5);
    let along = if half.x > half.y { Vec2::X } else { Vec2::Y };
    for side in [-1.0, 1.0] {
        let frame = site.frame(center + along * (side * ((half * along).length() - 0.8)), along);
        for y in [-2.5, 2.5] {
            let post = Block3::standing(0.0, y, 0.0, Vec3::new(0.12, 0.12, 2.1));
            site.mesh.block(&frame, post, site.palette.white, site.palette.white);
        }
        let bar = Block3 { min: Vec3::new(-0.06, -2.5, 2.0), max: Vec3::new(0.06, 2.5, 2.12) };
        site.mesh.hanging_block(&frame, bar, site.palette.white);
    }
}

/// A hall with a car park in front, containers and lorries behind.
pub(super) fn hall(site: &mut Site) {
    let size = site.size();
    let turned = size.y > size.x;
    let along = if turned { Vec2::Y } else { Vec2::X };
    let (a, b) = (site.block.min + PAVEMENT_M + 2.5, site.block.max - PAVEMENT_M - 2.5);
    let room = b - a;
    let share = 0.54;
    let built = if turned { Vec2::new(room.x, room.y * share) } else { Vec2::new(room.x * share, room.y) };
    let uv = a + built * 0.5;
    let local = if turned { Vec2::new(built.y, built.x) } else { built };
    let sawtooth = site.rng.chance(0.5);
    let cover = if sawtooth { Cover::Sheet } else { Cover::Felt };
    let wall = if site.rng.chance(0.5) { Wall::Boards } else { Wall::Panels };
    let style = hall_style(site, wall, cover, 0.35);
    let lot = site.lot(uv, along, local);
    let part = Footprint::around(0.0, 0.0, local);
    let top_m = 6.6;
    building::walls(site.mesh, &lot, &part.outline(), top_m, &style, &mut site.rng);
    if sawtooth {
        roof::sawtooth(site.mesh, &lot.frame, &part, top_m, &style, site.palette);
    } else {
        building::flat_roof(site.mesh, &lot.frame, &part.outline(), &[part], top_m, &style);
        building::roof_clutter(site.mesh, &lot.frame, &part, top_m, &style, site.palette, &mut site.rng);
    }
    let lot_min = if turned { a.with_y(a.y + built.y + 3.0) } else { a.with_x(a.x + built.x + 3.0) };
    car_park(site, (lot_min, b), turned);
    site.scatter(6, &[Habit::Broad], (4.0, 7.0));
}

/// Adds a car park: vehicles in some of the bays that [`Surface::CarPark`] paints.
fn car_park(site: &mut Site, (min, max): (Vec2, Vec2), turned: bool) {
    site.cover_rectangle((min, max), Surface::CarPark(turned));
    site.reserve((min, max));
    let size = max - min;
    let (wide, deep) = if turned { (size.y, size.x) } else { (size.x, size.y) };
    let place = |x: f32, y: f32| min + if turned { Vec2::new(y, x) } else { Vec2::new(x, y) };
    let heading = if turned { Vec2::X } else { Vec2::Y };
    for row in 0..(deep / 16.0) as usize + 1 {
        for depth in [2.5, 13.5] {
            let y = 16.0 * row as f32 + depth;
            for bay in 0..(wide / 2.5) as usize {
                if y + 2.5 > deep || !site.rng.chance(0.58) {
                    continue;
                }
                let uv = place(2.5 * (bay as f32 + 0.52), y + site.rng.signed() * 0.3);
                let heading = if site.rng.chance(0.5) { heading } else { -heading };
                let frame = site.frame(uv, heading);
                let kind = props::any_vehicle(&mut site.rng);
                props::vehicle(site.mesh, &frame, kind, site.palette, &mut site.rng);
            }
        }
    }
    for i in 0..2 {
        let uv = place(0.25 * wide + 0.4 * wide * i as f32, 8.0);
        let frame = site.frame(uv, heading.perp());
        if i == 0 {
            props::vehicle(site.mesh, &frame, props::Vehicle::Lorry, site.palette, &mut site.rng);
        } else {
            props::container(site.mesh, &frame, site.palette, &mut site.rng);
        }
    }
}

/// A style for a school or hall: this wall with this fraction of windows.
fn hall_style(site: &mut Site, wall: Wall, cover: Cover, windows: f32) -> Style {
    let style = Style::random(site.mesh, &mut site.rng, wall, cover, false);
    let facade =
        Facade { windows, bay_m: style.bay_m, floor_m: style.floor_m, ..Facade::random(wall, &mut site.rng) };
    Style { facade: site.mesh.add(Material::Facade(facade)), ..style }
}
