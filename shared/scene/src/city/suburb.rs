//! The blocks around the centre: villas in gardens, the park, the school, halls.

use glam::{Vec2, Vec3};

use super::building::{self, Footprint, Style};
use super::centre::{hall_style, shed};
use super::facade::Wall;
use super::mesh::Block3;
use super::paving::{Outline, PAVEMENT_M, Surface};
use super::props;
use super::roof;
use super::roofing::Cover;
use super::site::{Side, Site};
use super::tree::{self, Habit};

/// Detached houses with gardens along the two long sides.
pub(super) fn villas(site: &mut Site) {
    let size = site.size();
    let sides = site.sides();
    let long = if size.x >= size.y { [sides[0], sides[2]] } else { [sides[1], sides[3]] };
    let depth = 0.5 * size.min_element();
    for side in long {
        let plots = (side.length_m / 17.0).max(1.0) as usize;
        let width = (side.length_m - 2.0 * PAVEMENT_M) / plots as f32;
        for i in 0..plots {
            plot(site, &side, PAVEMENT_M + width * i as f32, width, depth);
        }
    }
    let area = size.x * size.y;
    site.scatter((area / 95.0) as usize, &[Habit::Broad, Habit::Broad, Habit::Conifer], (4.0, 11.0));
    site.scatter((area / 60.0) as usize, &[Habit::Bush], (1.0, 2.4));
}

/// One plot of `width_m` from `from_m` on along a side, `depth_m` deep.
fn plot(site: &mut Site, side: &Side, from_m: f32, width_m: f32, depth_m: f32) {
    let house = Vec2::new((width_m - 5.5).clamp(6.5, 11.5), (0.36 * depth_m).clamp(6.5, 9.5));
    let setback = (PAVEMENT_M + site.rng.range(2.5, 5.0)).min(depth_m - house.y - 2.0);
    let left = site.rng.chance(0.5);
    let middle = from_m + if left { 0.5 * house.x + 1.2 } else { width_m - 0.5 * house.x - 1.2 };
    let uv = side.at(middle, setback + 0.5 * house.y);
    detached_house(site, uv, side.along, house);
    let drive_at = from_m + if left { width_m - 1.7 } else { 1.7 };
    drive(site, side, drive_at, setback, width_m - house.x > 4.6);
    let path = side.rectangle((middle - 0.6, PAVEMENT_M), (middle + 0.6, setback));
    site.cover_rectangle(path, Surface::Flags(0.5));
    let terrace = side.rectangle(
        (middle - 0.4 * house.x, setback + house.y),
        (middle + 0.4 * house.x, setback + house.y + 3.2),
    );
    let paved = if site.rng.chance(0.5) { Surface::Deck } else { Surface::Flags(0.7) };
    site.cover_rectangle(terrace, paved);
    site.reserve(terrace);
    garden(site, side, (from_m, from_m + width_m), (setback + house.y + 3.6, depth_m));
    fences(site, side, from_m, width_m, depth_m);
}

fn drive(site: &mut Site, side: &Side, at: f32, setback: f32, garage: bool) {
    let end = setback + 2.0;
    let surface = site.rng.pick(&[Surface::Asphalt, Surface::Flags(0.4), Surface::Gravel, Surface::Cobbles]);
    let strip = side.rectangle((at - 1.5, PAVEMENT_M), (at + 1.5, end));
    site.cover_rectangle(strip, surface);
    site.reserve(strip);
    if site.rng.chance(0.65) {
        let frame = site.frame(side.at(at, PAVEMENT_M + 2.8), side.inward);
        let kind = props::any_vehicle(&mut site.rng);
        props::vehicle(site.mesh, &frame, kind, site.palette, &mut site.rng);
    }
    if garage {
        let uv = side.at(at, end + 2.8);
        shed(site, uv, side.along, Vec2::new(3.1, 5.6));
    }
}

fn detached_house(site: &mut Site, uv: Vec2, along: Vec2, size_m: Vec2) {
    let wall = site.rng.pick(&[Wall::Plaster, Wall::Plaster, Wall::Brick, Wall::Timbered, Wall::Boards]);
    let cover = site.steep_cover();
    let modern = site.rng.chance(0.16);
    let cover = if modern { site.flat_cover() } else { cover };
    let style = Style::random(site.mesh, &mut site.rng, wall, cover, false);
    let lot = site.lot(uv, along, size_m);
    let part = Footprint::around(0.0, 0.0, size_m);
    let floors = 1 + site.rng.index(2) as u32;
    let top_m = style.height_m(floors) + 0.3;
    if modern {
        building::walls(site.mesh, &lot, &part.outline(), top_m, &style, &mut site.rng);
        building::flat_roof(site.mesh, &lot.frame, &part.outline(), &[part], top_m, &style);
        let upper = Footprint { min: part.min + 0.3, max: part.max - part.size() * Vec2::new(0.45, 0.1) };
        let top = top_m + style.floor_m;
        building::raised_walls(site.mesh, &lot.frame, &upper.outline(), [top_m, top], &style, &mut site.rng);
        building::flat_roof(site.mesh, &lot.frame, &upper.outline(), &[upper], top, &style);
        return;
    }
    building::walls(site.mesh, &lot, &part.outline(), top_m, &style, &mut site.rng);
    let pitch = site.rng.range(0.6, 1.0);
    let crosswise = site.rng.chance(0.35);
    if site.rng.chance(0.28) {
        roof::hipped(site.mesh, &lot.frame, &part, top_m, 0.7 * pitch, &style);
    } else if crosswise {
        let frame = lot.frame.turned(Vec2::Y);
        let turned = Footprint::around(0.0, 0.0, Vec2::new(size_m.y, size_m.x));
        roof::gabled(site.mesh, &frame, &turned, top_m, pitch, &style, &mut site.rng);
    } else {
        roof::gabled(site.mesh, &lot.frame, &part, top_m, pitch, &style, &mut site.rng);
        if site.rng.chance(0.45) {
            wing(site, &lot, size_m, top_m, pitch, &style);
        }
    }
    let shorter = if crosswise { size_m.x } else { size_m.y };
    let at = Vec2::new(0.22 * size_m.x, 0.12 * size_m.y);
    let ridge = top_m + pitch * 0.5 * shorter;
    building::chimney(site.mesh, &lot.frame, at, [top_m - 1.0, ridge + 0.5], site.palette);
}

/// A gabled wing towards the garden: the house becomes an L.
fn wing(site: &mut Site, lot: &building::Lot, size_m: Vec2, top_m: f32, pitch: f32, style: &Style) {
    let width = 0.45 * size_m.x;
    let x = 0.5 * (size_m.x - width) * if site.rng.chance(0.5) { 1.0 } else { -1.0 };
    let frame = lot.frame.moved(x, 0.0, 0.0).turned(Vec2::Y);
    let part =
        Footprint { min: Vec2::new(0.0, -0.5 * width), max: Vec2::new(0.5 * size_m.y + 3.6, 0.5 * width) };
    let wing_lot = building::Lot { frame, depth_m: lot.depth_m + 0.6 };
    building::walls(site.mesh, &wing_lot, &part.outline(), top_m, style, &mut site.rng);
    roof::gabled(site.mesh, &frame, &part, top_m, pitch, style, &mut site.rng);
}

/// What a back garden between these distances may have.
fn garden(site: &mut Site, side: &Side, along: (f32, f32), depth: (f32, f32)) {
    if depth.1 - depth.0 < 4.5 {
        return;
    }
    let at = |t: f32, s: f32| (along.0 + (along.1 - along.0) * t, depth.0 + (depth.1 - depth.0) * s);
    match site.rng.index(6) {
        0 => {
            let pool = side.rectangle(at(0.25, 0.2), at(0.75, 0.7));
            site.cover_rectangle(pool, Surface::Pool);
            site.reserve(pool);
        }
        1 | 2 => {
            let beds = side.rectangle(at(0.1, 0.3), at(0.55, 0.85));
            site.cover_rectangle(beds, Surface::Crop(site.block.seed & 1 == 0, 0));
            site.reserve(beds);
        }
        3 => {
            let (x, y) = at(0.5, 0.5);
            let uv = side.at(x, y);
            let frame = site.frame(uv, Vec2::X);
            // A trampoline.
            site.mesh.drum(&frame, [1.9; 2], [0.65, 0.75], 12, [site.palette.steel, site.palette.dark]);
            site.reserve((uv - 2.0, uv + 2.0));
        }
        _ => {
            let (x, y) = at(0.78, 0.68);
            let uv = side.at(x, y);
            if site.is_free(uv, 1.6) {
                shed(site, uv, side.along, Vec2::new(3.0, 2.4));
            }
        }
    }
}

fn fences(site: &mut Site, side: &Side, from_m: f32, width_m: f32, depth_m: f32) {
    let hedge = site.rng.chance(0.45);
    let front_gap = (from_m + 0.35 * width_m, from_m + 0.65 * width_m);
    let lines = [
        ((from_m, PAVEMENT_M + 0.5), (from_m, depth_m)),
        ((from_m, depth_m - 0.3), (from_m + width_m, depth_m - 0.3)),
        ((from_m + 3.4, PAVEMENT_M + 0.5), (front_gap.0, PAVEMENT_M + 0.5)),
        ((front_gap.1, PAVEMENT_M + 0.5), (from_m + width_m - 3.4, PAVEMENT_M + 0.5)),
    ];
    for (a, b) in lines {
        let length = (a.0 - b.0).abs() + (a.1 - b.1).abs();
        let pieces = (length / 5.0) as usize + 1;
        let point = |i: usize| {
            let t = i as f32 / pieces as f32;
            site.ground(side.at(a.0 + (b.0 - a.0) * t, a.1 + (b.1 - a.1) * t))
        };
        let points: Vec<Vec3> = (0..=pieces).map(point).collect();
        for pair in points.windows(2) {
            if hedge {
                tree::hedge(site.mesh, pair[0], pair[1], 1.4, site.palette, &mut site.rng);
            } else {
                props::barrier(site.mesh, pair[0], pair[1], 1.2, 0.07, site.palette.fence);
            }
        }
    }
}

/// Lawns and groves, winding paths, and a pond where the terrain has its bowl.
pub(super) fn park(site: &mut Site, pond: Option<(Vec2, f32, f32)>) {
    let size = site.size();
    let at = |x: f32, y: f32| site.block.min + size * Vec2::new(x, y);
    let stops = [
        at(0.06, 0.06),
        at(0.22, 0.18),
        at(0.30, 0.42),
        at(0.22, 0.66),
        at(0.40, 0.86),
        at(0.66, 0.88),
        at(0.85, 0.78),
        at(0.94, 0.94),
        at(0.85, 0.78),
        at(0.84, 0.46),
        at(0.76, 0.20),
        at(0.94, 0.06),
        at(0.76, 0.20),
        at(0.48, 0.14),
        at(0.22, 0.18),
    ];
    let paths: Vec<(Vec2, Vec2)> = stops.windows(2).map(|pair| (pair[0], pair[1])).collect();
    for (a, b) in paths {
        site.cover(Outline::Strip(a, b, 2.4), Surface::Gravel);
        for i in 0..4 {
            let uv = a + (b - a) * (i as f32 / 3.0);
            site.reserve((uv - 1.3, uv + 1.3));
        }
        let middle = (a + b) * 0.5 + (b - a).perp().normalize_or_zero() * 1.9;
        if site.rng.chance(0.6) {
            let frame = site.frame(middle, b - a);
            props::bench(site.mesh, &frame, site.palette);
        }
    }
    if let Some((uv, radius_m, level)) = pond {
        site.cover(Outline::Disc(uv, 1.1 * radius_m), Surface::Gravel);
        site.reserve((uv - radius_m, uv + radius_m));
        let mut frame = site.frame(uv, Vec2::X);
        frame.origin.z = level;
        site.mesh.drum(&frame, [1.02 * radius_m; 2], [-0.02, 0.0], 28, [site.palette.water; 2]);
        for _ in 0..26 {
            let d = super::mesh::unit_circle(site.rng.unit()) * (radius_m * site.rng.range(1.0, 1.12));
            let height = site.rng.range(0.6, 1.5);
            let frame = site.frame(uv + d, Vec2::X);
            let detail = site.detail();
            tree::tree(site.mesh, &frame, Habit::Bush, height, detail, site.palette, &mut site.rng);
        }
    }
    let area = size.x * size.y;
    let habits = [Habit::Broad, Habit::Broad, Habit::Broad, Habit::Conifer, Habit::Poplar];
    site.scatter((area / 62.0) as usize, &habits, (5.0, 15.0));
    site.scatter((area / 130.0) as usize, &[Habit::Bush], (0.9, 2.2));
}

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

/// Bays in double rows as the surface paints them, partly taken.
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
