//! Detached houses in gardens.

use glam::{Vec2, Vec3};

use super::common;
use super::site::{Side, Site};
use crate::building::{self, Footprint, Style};
use crate::facade::Wall;
use crate::paving::{PAVEMENT_M, Surface};
use crate::props;
use crate::roof;
use crate::tree::{self, Habit};

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

/// A plot along a side that begins at `from_m`, `width_m` wide and `depth_m` deep.
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
        common::shed(site, uv, side.along, Vec2::new(3.1, 5.6));
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

/// Adds a gabled wing towards the garden, so that the house becomes L-shaped.
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

/// Adds a pool, beds, a trampoline or a shed to the back garden between these distances.
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
                common::shed(site, uv, side.along, Vec2::new(3.0, 2.4));
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
