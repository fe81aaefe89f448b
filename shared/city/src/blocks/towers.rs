//! Stepped towers, and long apartment houses.

use glam::Vec2;

use super::common;
use super::site::Site;
use crate::building::{self, Footprint, Style};
use crate::facade::Wall;
use crate::paving::{Outline, PAVEMENT_M, Surface};
use crate::props;
use crate::roofing::Cover;
use crate::tree::Habit;

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
    common::avenue(site, 7.0, 6.0);
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
    let lot = site.lot(uv, along, size_m);
    let main = Footprint::around(0.0, 0.0, size_m);
    let top_m = style.height_m(floors) + 0.4;
    building::walls(site.mesh, &lot, &main.outline(), top_m, &style, &mut site.rng);
    building::flat_roof(site.mesh, &lot.frame, &main.outline(), &[main], top_m, &style);
    building::roof_clutter(site.mesh, &lot.frame, &main, top_m, &style, site.palette, &mut site.rng);
    // Balconies are on the side y < 0.
    let columns = (size_m.x / 7.0) as usize;
    for column in 0..columns {
        let x = (column as f32 + 0.5 - 0.5 * columns as f32) * 7.0;
        for floor in 1..floors {
            let z = style.height_m(floor);
            building::balcony(site.mesh, &lot.frame, x, -0.5 * size_m.y, z, &style);
        }
    }
}
