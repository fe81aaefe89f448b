//! Open country around the town: fields, meadows, woods, orchards, farms.

use glam::{Vec2, Vec3};

use super::site::Site;
use crate::building::{self, Footprint, Style};
use crate::facade::Wall;
use crate::paving::{Outline, Surface};
use crate::props;
use crate::roof;
use crate::roofing::Cover;
use crate::tree::{self, Habit};

/// Crops, perhaps with a line of trees along one side.
pub(super) fn field(site: &mut Site) {
    if site.rng.chance(0.6) {
        let side = site.sides()[site.rng.index(4)];
        for i in 0..(side.length_m / 9.0) as usize {
            if site.rng.chance(0.6) {
                let uv = side.at(9.0 * i as f32 + site.rng.range(2.0, 7.0), site.rng.range(1.5, 4.0));
                let habit = site.rng.pick(&[Habit::Broad, Habit::Bush, Habit::Poplar]);
                let height = site.rng.range(2.0, 11.0);
                site.plant(uv, habit, height);
            }
        }
    }
    if site.rng.chance(0.5) {
        let side = site.sides()[0];
        let strip = side.rectangle((0.0, 0.45 * site.size().y), (side.length_m, site.size().y));
        let crop = Surface::Crop(site.block.seed & 1 == 1, (site.block.seed >> 5) as u8 % 4);
        site.cover_rectangle(strip, crop);
    }
}

/// Grass with single trees, bales and bushes.
pub(super) fn meadow(site: &mut Site) {
    let area = site.size().x * site.size().y;
    site.scatter((area / 420.0) as usize, &[Habit::Broad, Habit::Bush], (2.0, 12.0));
    for _ in 0..(area / 330.0) as usize {
        if let Some(uv) = site.free_spot(1.0) {
            let along = Vec2::new(site.rng.signed(), 0.7);
            let frame = site.frame(uv, along.normalize());
            props::bale(site.mesh, &frame, site.palette);
        }
    }
    let (a, b) = (site.block.min, site.block.max);
    let middle = (a + b) * 0.5 + Vec2::new(6.0, -4.0);
    site.cover(Outline::Strip(a, middle, 1.8), Surface::Soil);
    site.cover(Outline::Strip(middle, b.with_y(a.y + 0.7 * (b.y - a.y)), 1.8), Surface::Soil);
}

/// Trees close together.
pub(super) fn forest(site: &mut Site) {
    let size = site.size();
    let habits: &[Habit] = if site.rng.chance(0.4) {
        &[Habit::Conifer, Habit::Conifer, Habit::Broad]
    } else {
        &[Habit::Broad, Habit::Broad, Habit::Broad, Habit::Conifer]
    };
    let spacing = 6.0;
    for y in 0..(size.y / spacing) as usize {
        for x in 0..(size.x / spacing) as usize {
            let jitter = Vec2::new(site.rng.unit(), site.rng.unit());
            let uv = site.block.min + (Vec2::new(x as f32, y as f32) + jitter) * spacing;
            if site.rng.chance(0.85) {
                let habit = site.rng.pick(habits);
                let height = site.rng.range(8.0, 16.0);
                site.plant(uv, habit, height);
            }
        }
    }
}

/// Fruit trees in rows.
pub(super) fn orchard(site: &mut Site) {
    let size = site.size();
    let spacing = 5.5;
    for y in 0..((size.y - 4.0) / spacing) as usize {
        for x in 0..((size.x - 4.0) / spacing) as usize {
            if site.rng.chance(0.92) {
                let jitter = Vec2::new(site.rng.signed(), site.rng.signed()) * 0.25;
                let uv = site.block.min + (Vec2::new(x as f32, y as f32) + 0.8) * spacing + jitter;
                let height = site.rng.range(2.8, 4.2);
                site.plant(uv, Habit::Broad, height);
            }
        }
    }
}

/// A farmhouse, barns, a silo, and a yard.
pub(super) fn farm(site: &mut Site) {
    let center = site.center();
    site.cover_rectangle((site.block.min, site.block.max), Surface::Meadow);
    site.cover(Outline::Disc(center, 17.0), Surface::Gravel);
    let house =
        (center + Vec2::new(-11.0, -9.0), Vec2::X, Vec2::new(13.0, 8.5), Wall::Brick, Cover::Tiles, 2);
    let barn = (center + Vec2::new(12.0, 2.0), Vec2::Y, Vec2::new(24.0, 11.0), Wall::Boards, Cover::Sheet, 1);
    let stable =
        (center + Vec2::new(-8.0, 13.0), Vec2::X, Vec2::new(18.0, 7.5), Wall::Boards, Cover::Tiles, 1);
    for (uv, along, size_m, wall, cover, floors) in [house, barn, stable] {
        let style = Style::random(site.mesh, &mut site.rng, wall, cover, false);
        let lot = site.lot(uv, along, size_m);
        let part = Footprint::around(0.0, 0.0, size_m);
        let top_m = style.height_m(floors) + 0.6;
        building::walls(site.mesh, &lot, &part.outline(), top_m, &style, &mut site.rng);
        roof::gabled(site.mesh, &lot.frame, &part, top_m, 0.75, &style, &mut site.rng);
    }
    let uv = center + Vec2::new(2.0, -12.0);
    let silo = site.frame(uv, Vec2::X);
    site.mesh.drum(&silo, [2.2; 2], [-0.4, 8.5], 14, [site.palette.concrete, site.palette.steel]);
    site.mesh.drum(&silo.moved(0.0, 0.0, 8.5), [2.3, 0.0], [0.0, 1.3], 14, [site.palette.steel; 2]);
    site.reserve((uv - 3.0, uv + 3.0));
    let tractor = site.frame(center, Vec2::X);
    props::vehicle(site.mesh, &tractor, props::Vehicle::Lorry, site.palette, &mut site.rng);
    site.scatter(22, &[Habit::Broad, Habit::Broad, Habit::Bush, Habit::Conifer], (3.0, 13.0));
    let corners = [site.block.min + 1.5, site.block.max - 1.5];
    let line = [corners[0], corners[0].with_x(corners[1].x), corners[1]];
    for pair in line.windows(2) {
        let pieces = (pair[0].distance(pair[1]) / 6.0) as usize + 1;
        let points: Vec<Vec3> = (0..=pieces)
            .map(|i| site.ground(pair[0] + (pair[1] - pair[0]) * (i as f32 / pieces as f32)))
            .collect();
        for ends in points.windows(2) {
            tree::hedge(site.mesh, ends[0], ends[1], 1.6, site.palette, &mut site.rng);
        }
    }
}
